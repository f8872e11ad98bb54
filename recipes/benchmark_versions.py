"""Run times of this version against another: a benchmark of both, in turn, each in a process of its own.

    python recipes/benchmark_versions.py other=../before ["options=['batches=[1,200]','curves=false']"] [rounds=3]

`other` is a checkout of another version, say of `git worktree add ../before v0.1.0`; both run in this environment.
Prints medians over the rounds of every time that both measure, and the median of the rounds' ratios: on a shared
machine times drift, their ratio within a round less. No figure of the paper. Takes the benchmark's time, twice a round.
Results: docs/results/pure-steps.md.

Writes config.yaml and metrics.json to its run folder.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import hydra
from omegaconf import DictConfig
from tqdm import tqdm

from _common import as_list, clean_exit, finish_run, open_run, with_help

HERE = Path(__file__).resolve().parents[1]


def times(checkout: Path, cfg: DictConfig) -> dict[str, float]:
    """Milliseconds of a benchmark of a checkout, by name; ValueError if it fails."""
    environment = os.environ | {"PYTHONPATH": str(checkout)}
    asked = "import torchrl_gn; print(torchrl_gn.__file__)"
    found = subprocess.run([sys.executable, "-c", asked], env=environment, cwd=checkout, capture_output=True, text=True)
    if not Path(found.stdout.strip()).is_relative_to(checkout):
        raise ValueError(f"{checkout} is no checkout of torchrl_gn: {found.stdout or found.stderr}")
    with TemporaryDirectory() as folder:
        command = [sys.executable, str(checkout / "recipes" / f"{cfg.recipe}.py"), *as_list(cfg.options)]
        command.append(f"run_dir={folder}/run")
        done = subprocess.run(command, env=environment, cwd=checkout, capture_output=True, text=True)
        if done.returncode:
            raise ValueError(f"The benchmark of {checkout} failed:\n{done.stderr}")
        metrics = json.loads((Path(folder) / "run" / "metrics.json").read_text())
    return {name: value for name, value in metrics.items() if name.endswith("/milliseconds")}


@with_help
@hydra.main(version_base=None, config_path="config", config_name="benchmark_versions")
@clean_exit
def main(cfg: DictConfig) -> None:
    if cfg.rounds < 1:
        raise ValueError(f"rounds={cfg.rounds} must be 1 or more.")
    run, tracker = open_run(cfg, "benchmark_versions")
    versions = {"before": Path(cfg.other).resolve(), "now": HERE}
    found: dict[str, list[dict[str, float]]] = {name: [] for name in versions}
    for name in tqdm([*versions] * cfg.rounds, desc="measuring", leave=False):
        found[name].append(times(versions[name], cfg))
    metrics: dict[str, float] = {}
    print(f"{'milliseconds':52}{'before':>10}{'now':>10}{'now / before':>14}")
    for name in (each for each in found["now"][0] if each in found["before"][0]):
        rounds = [(before[name], now[name]) for before, now in zip(found["before"], found["now"], strict=True)]
        before, now = (median(each[index] for each in rounds) for index in (0, 1))
        ratio, work = median(now / before for before, now in rounds), name.removesuffix("/milliseconds")
        metrics |= {f"{work}/before": before, f"{work}/now": now, f"{work}/ratio": ratio}
        print(f"{work:52}{before:>10.4f}{now:>10.4f}{ratio:>14.2f}")
    finish_run(cfg, run, tracker, metrics)


if __name__ == "__main__":
    main()
