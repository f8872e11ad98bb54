"""Compare graph networks with the best of many MLPs, system by system.

    python recipes/mlp_baseline.py [systems=[pendulum,swimmer6]] [minutes=4] [seeds=[0]]

Reproduces the paper's Figure "Prediction errors ... between the best MLP baseline and the best GN model". For every
system:

1. Train MLPs of the paper's five sizes with every optimiser and rate of the sweep for `screen_minutes` (paper, SM "MLP
   baseline architectures").
2. Train the `keep` MLPs with the lowest errors of validation rollouts for `minutes`; the best of these is the baseline.
3. Compare it with the graph network over all seeds, with the same normalisers, features, state update, data and
   training time.

The same `run_dir` keeps finished runs and resumes. Results: docs/results/gn-against-mlp.md.

Writes config.yaml, metrics.json, the table as table.md, bars of the errors as errors.png, and each run with its log to
its run folder.
"""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from statistics import mean

import hydra
from omegaconf import DictConfig

from _common import as_list, clean_exit, open_log, with_help
from _common.sweeps import (
    FORWARD_MODEL,
    Run,
    best,
    folder_name,
    mean_and_half_range,
    refuse_changes,
    report_sweep,
    run_all,
)
from torchrl_gn.training import RunFolder

ERRORS = {"one_step_error": "one step", "rollout_error_20": "20 steps", "rollout_error_100": "100 steps"}


def make_run(cfg: DictConfig, folder: Path, system: str, name: str, options: list[str], minutes: float, seed: int):
    """Return the run that trains one network on one system."""
    shared = [f"system={system}", "steps=null", f"minutes={minutes}", f"clock={cfg.clock}"]
    shared += [f"seed={seed}", f"threads={cfg.threads}"]
    place = folder / system / folder_name(name) / f"minutes{minutes}_seed{seed}"
    overrides = (*shared, f"data.folder={cfg.data_dir}", *as_list(cfg.overrides), *options)
    return Run(FORWARD_MODEL, place, overrides, f"{system}, {name}, {minutes} minutes, seed {seed}")


def candidates(cfg: DictConfig) -> dict[str, list[str]]:
    """Return the options of every MLP of the sweep by name."""
    found = {}
    for (layers, cells), optimizer in itertools.product(cfg.sizes, cfg.optimizers):
        options = ["model.core=mlp", f"model.hidden={cells}", f"model.layers={layers}", *optimizer]
        found[f"MLP {layers} x {cells}, {', '.join(optimizer)}"] = options
    return found


def values(runs: list[Run], key: str) -> list[float]:
    """Return a metric of every finished run; infinite where it diverged."""
    return [numbers[key] for run in runs if (numbers := run.numbers())]


@with_help
@hydra.main(config_path="config", config_name="mlp_baseline", version_base="1.3")
@clean_exit
def main(cfg: DictConfig) -> None:
    folder = RunFolder(cfg.run_dir, "mlp_baseline")
    if cfg.data_dir is None:
        cfg.data_dir = str(folder.data)
    systems, seeds = as_list(cfg.systems), as_list(cfg.seeds)
    mlps, first = candidates(cfg), seeds[0]

    def runs(system: str, names: list[str], minutes: float, seeds: list[int]) -> list[Run]:
        known = {**mlps, "GN": []}
        every = itertools.product(names, seeds)
        return [make_run(cfg, folder.path, system, name, known[name], minutes, seed) for name, seed in every]

    names = list(mlps)
    screened = {system: runs(system, names, cfg.screen_minutes, [first]) for system in systems}
    refuse_changes(run for group in screened.values() for run in group)
    tracker = open_log(cfg, folder)
    failed = run_all([run for group in screened.values() for run in group], cfg.jobs, desc="screening")
    long = {}
    for system, group in screened.items():
        best_runs = [names[group.index(run)] for run in best(group, "validation_error", cfg.keep)]
        long[system] = dict(zip(runs(system, best_runs, cfg.minutes, [first]), best_runs, strict=True))
    failed += run_all([run for group in long.values() for run in group], cfg.jobs, desc="training the best")
    # A system whose runs all failed has no winner.
    winners = {system: group[run] for system, group in long.items() for run in best(list(group), "validation_error")}
    final = {
        (system, kind): runs(system, [name], cfg.minutes, seeds)
        for system, winner in winners.items()
        for kind, name in (("GN", "GN"), ("MLP", winner))
    }
    failed += run_all([run for group in final.values() for run in group], cfg.jobs, desc="training over seeds")

    metrics: dict[str, float | int | str] = {}
    bars: dict[str, dict[str, dict[str, tuple[float, float]]]] = {}
    kinds = ("GN", "MLP", "MLP / GN")
    header = ["errors (lower is better)", *(f"{kind}, {title}" for title in ERRORS.values() for kind in kinds)]
    lines = ["| " + " | ".join([*header, "best MLP", "updates"]) + " |", "|---" * (len(header) + 2) + "|"]
    for system, winner in winners.items():
        cells = []
        for key, title in ERRORS.items():
            centers = {}
            for kind in ("GN", "MLP"):
                found = values(final[system, kind], key)
                if not found:
                    cells.append("-")
                    continue
                centers[kind], half_range = mean_and_half_range(found)
                metrics |= {f"{system}/{kind}/{key}": centers[kind], f"{system}/{kind}/{key}/half_range": half_range}
                bars.setdefault(title, {}).setdefault(kind, {})[system] = (centers[kind], half_range)
                cells.append(f"{centers[kind]:.1e} ± {half_range:.0e}")
            ratio = centers["MLP"] / centers["GN"] if len(centers) == 2 else math.nan
            metrics[f"{system}/ratio/{key}"] = ratio
            cells.append(f"{ratio:.2g}")
        steps = " / ".join(f"{mean(values(final[system, kind], 'steps') or [0]):,.0f}" for kind in ("GN", "MLP"))
        metrics[f"{system}/best"] = winner
        lines.append("| " + " | ".join([system, *cells, winner, steps]) + " |")
    report_sweep(folder, lines, bars, metrics, failed, tracker, seed=first)


if __name__ == "__main__":
    main()
