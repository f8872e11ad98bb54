"""Train variants of the forward model for equal time, side by side, and compare their errors.

    python recipes/compare.py [systems=[swimmer6,cheetah]] [minutes=3] [seeds=[0]] [only=[default,no linking]]

Every variant is a run of recipes/forward_model.py with the overrides that recipes/config/compare.yaml names, on the
same data. Finished runs are kept and interrupted ones go on when the recipe is started again with the same run_dir;
runs that fail are listed and the others go on. The table shows means over seeds and, with several, the
half-range; the last column is the geometric mean of errors over systems and horizons, relative to the
first variant. What came out: docs/results.md.

Writes config.yaml, metrics.json, the table as table.md, and each run with its log to its run folder.
"""

from __future__ import annotations

import itertools
import json
import math
import re
import shlex
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any, cast

import hydra
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from torchrl_gn.atomic import atomic_path
from torchrl_gn.training import RunFolder, clean_exit

RECIPE = Path(__file__).with_name("forward_model.py")
COLUMNS = {"one_step_error": "one-step", "rollout_error_100": "100 steps", "steps": "updates"}


@dataclass(frozen=True)
class Run:
    """One training."""

    system: str
    variant: str
    seed: int
    overrides: tuple[str, ...]
    folder: Path

    @property
    def metrics(self) -> dict[str, Any] | None:
        """What it measured, if it is done."""
        path = self.folder / "metrics.json"
        return json.loads(path.read_text()) if path.exists() else None


class Runner:
    """Runs the recipe in processes of its own, and ends them with this one."""

    def __init__(self) -> None:
        self.processes: set[subprocess.Popen] = set()
        self.stopped = False

    def __call__(self, run: Run) -> int:
        """Train, unless that is done; the exit code."""
        if run.metrics is not None:
            return 0
        if self.stopped:
            return 130
        run.folder.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, str(RECIPE), f"run_dir={run.folder}", *run.overrides]
        with (run.folder / "log.txt").open("a") as log:
            log.write(f"$ {shlex.join(command)}\n")
            log.flush()
            # In a session of its own, so that Ctrl-C reaches it once, from here.
            process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
            self.processes.add(process)
            try:
                return process.wait()
            finally:
                self.processes.discard(process)

    def stop(self) -> None:
        """Tell all runs to end: they save themselves."""
        self.stopped = True
        for process in list(self.processes):
            process.terminate()


def all_runs(cfg: DictConfig, folder: Path) -> list[Run]:
    """Every system, variant and seed, system by system, seed by seed."""
    variants = cast(dict[str, list[str]], OmegaConf.to_container(cfg.variants))
    chosen = list(variants) if cfg.only is None else list(cfg.only)
    unknown = [name for name in chosen if name not in variants]
    if unknown:
        raise ValueError(f"Variants {unknown} are not known; use some of {list(variants)}.")
    runs = []
    for seed, system, name in itertools.product(cfg.seeds, cfg.systems, chosen):
        shared = [
            f"system={system}",
            f"seed={seed}",
            f"minutes={cfg.minutes}",
            f"clock={cfg.clock}",
            f"threads={cfg.threads}",
        ]
        shared += [f"data.folder={Path(cfg.data_dir) / system}", *cfg.overrides]
        # Hydra reads a comma in an override as a list.
        path = folder / system / re.sub(r"[^\w.%-]+", "_", name) / f"seed{seed}"
        runs.append(Run(system, name, seed, (*shared, *variants[name]), path))
    return runs


def train(runs: list[Run], jobs: int) -> list[Run]:
    """Train ``jobs`` at a time; those that failed."""
    runner, failed = Runner(), []
    # The first of a system collects the data that the others share.
    first = {run.system: run for run in reversed(runs) if run.metrics is None}
    later = [run for run in runs if run is not first.get(run.system)]
    with tqdm(total=len(runs), desc="training", unit="run", leave=False) as bar, ThreadPoolExecutor(jobs) as pool:
        try:
            for part in (list(first.values()), later):
                futures = {pool.submit(runner, run): run for run in part}
                for future in as_completed(futures):
                    run = futures[future]
                    if future.result():
                        failed.append(run)
                        tqdm.write(
                            f"failed: {run.system}, {run.variant}, seed {run.seed}; see {run.folder / 'log.txt'}"
                        )
                    bar.update()
        except KeyboardInterrupt:
            runner.stop()
            while runner.processes:
                time.sleep(0.1)
            raise
    return failed


def summarise(runs: list[Run]) -> tuple[list[str], dict[str, float]]:
    """Table in Markdown, and metrics."""
    systems, variants = (list(dict.fromkeys(getattr(run, key) for run in runs)) for key in ("system", "variant"))
    metrics: dict[str, float] = {}
    cells: dict[str, list[str]] = {variant: [] for variant in variants}
    scores: dict[str, list[float]] = {variant: [] for variant in variants}
    for system, column, variant in itertools.product(systems, COLUMNS, variants):
        done = [r.metrics for r in runs if (r.system, r.variant) == (system, variant)]
        values = [math.inf if m[column] is None else float(m[column]) for m in done if m is not None]
        if not values:
            cells[variant].append("-")
            continue
        spread = (max(values) - min(values)) / 2
        metrics[f"{system}/{variant}/{column}"] = mean(values)
        if column == "steps":
            cells[variant].append(f"{mean(values):,.0f}")
            continue
        cells[variant].append(f"{mean(values):.1e}" + (f" ± {spread:.0e}" if len(values) > 1 else ""))
        metrics[f"{system}/{variant}/{column}/half_range"] = spread
        base = metrics.get(f"{system}/{variants[0]}/{column}")
        if base:
            scores[variant].append(math.log(mean(values) / base))
    header = ["", *(f"{system}, {name}" for system in systems for name in COLUMNS.values()), "relative"]
    lines = ["| " + " | ".join(header) + " |", "|---" * len(header) + "|"]
    for variant in variants:
        relative = math.exp(mean(scores[variant])) if scores[variant] else math.nan
        metrics[f"relative/{variant}"] = relative
        lines.append("| " + " | ".join([variant, *cells[variant], f"{relative:.2f}"]) + " |")
    return lines, metrics


@hydra.main(config_path="config", config_name="compare", version_base="1.3")
@clean_exit
def main(cfg: DictConfig) -> None:
    folder = RunFolder(cfg.run_dir, "compare")
    if cfg.data_dir is None:
        cfg.data_dir = str(folder.data)
    runs = all_runs(cfg, folder.path)
    folder.write_config(OmegaConf.to_yaml(cfg, resolve=True))
    failed = train(runs, cfg.jobs)
    lines, metrics = summarise(runs)
    with atomic_path(folder.file("table.md")) as temporary:
        temporary.write_text("\n".join(lines) + "\n")
    folder.write_metrics({**metrics, "failed": len(failed)}, seed=cfg.seeds[0])
    print("\n".join(lines))
    for path in folder.written:
        print(path)
    if failed:
        raise ValueError(f"{len(failed)} of {len(runs)} runs failed; see their log.txt. Start again to go on.")


if __name__ == "__main__":
    main()
