"""Compare the run times of this version and another: the same work of a shipped model, in turn.

    python recipes/benchmarks/versions.py other=../before [system=swimmer6] [rounds=5]

`other` is a checkout of another version, made by `git worktree add ../before v0.1.0`, say; both run in this
environment, in their own processes. Times steps, rollouts and their gradients of the specialised model, rollouts of the
bound one, and training steps, in processor time of all threads. Prints medians over rounds of the times, and of their
ratio within a round, which drifts less than the times on a shared machine. No figure of the paper. Takes minutes.
Results: docs/results/pure-steps.md.

Writes config.yaml and metrics.json to its run folder.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import hydra
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

sys.path.append(str(Path(__file__).parents[1]))  # where _common is

from _common import clean_exit, finish_run, open_run, parent, with_help
from _common.parent import run_child

HERE = Path(__file__).resolve().parents[2]


def start(cfg: DictConfig, checkout: Path) -> dict[str, float]:
    """Return median milliseconds of all work by the library of a checkout; ValueError if it fails."""
    places = os.pathsep.join(map(str, (checkout, Path(__file__).resolve().parent)))
    environment = os.environ | {"PYTHONPATH": places, "OMP_NUM_THREADS": str(cfg.threads)}
    with TemporaryDirectory() as folder:
        place = Path(folder) / "options.json"
        place.write_text(json.dumps(OmegaConf.to_container(cfg, resolve=True)))
        command = [sys.executable, "-W", "ignore", parent.__file__, "_version_times", str(place)]
        done = run_child(command, env=environment, cwd=checkout)
        if done.returncode:
            raise ValueError(f"The version in {checkout} failed:\n{done.stderr}")
        found = json.loads(place.read_text())
    if not Path(found["library"]).is_relative_to(checkout):
        raise ValueError(f"{checkout} is not a checkout of torchrl_gn.")
    return found["times"]


@with_help
@hydra.main(version_base=None, config_path="config", config_name="versions")
@clean_exit
def main(cfg: DictConfig) -> None:
    if cfg.other is None:
        raise ValueError("other=null must be the folder of a checkout of the other version.")
    if cfg.rounds < 1:
        raise ValueError(f"rounds={cfg.rounds} must be 1 or more.")
    run, tracker = open_run(cfg, "benchmarks/versions")
    versions = {"before": Path(cfg.other).resolve(), "now": HERE}
    found: dict[str, list[dict[str, float]]] = {name: [] for name in versions}
    for name in tqdm([*versions] * cfg.rounds, desc="measuring", leave=False):
        found[name].append(start(cfg, versions[name]))
    metrics: dict[str, float] = {"threads": cfg.threads}
    print("Milliseconds, medians: lower is better. now / before below 1: faster now.")
    print(f"{'work':40}{'before':>10}{'now':>10}{'now / before':>14}")
    for work in found["now"][0]:
        rounds = [(before[work], now[work]) for before, now in zip(found["before"], found["now"], strict=True)]
        before, now = (median(each[index] for each in rounds) for index in (0, 1))
        ratio = median(now / before for before, now in rounds)
        metrics |= {f"{work}/before": before, f"{work}/now": now, f"{work}/ratio": ratio}
        print(f"{work:40}{before:>10.3f}{now:>10.3f}{ratio:>14.2f}")
    finish_run(cfg, run, tracker, metrics)


if __name__ == "__main__":
    main()
