"""An hour of planning, learning and dropping what did it: ``python -m tests.faults.soak [--minutes 60] [--csv PATH]``.

Memory, threads and open files must stay flat: the least of each may grow by at most 1 % after the first five minutes
(or a twelfth of a shorter run). Each round makes everything anew: a scene, a model, its predictors, planners,
environments, trajectories and a checkpoint.
"""

from __future__ import annotations

import argparse
import csv
import gc
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from tensordict import TensorDict

import torchrl_gn as gn

ALLOWED = 1.01
SYSTEMS = ("pendulum", "cartpole", "acrobot", "swimmer3", "swimmer6", "cheetah")
HIDDEN = (8, 16, 24)


@dataclass
class Level:
    """Resources of this process: resident memory in MiB, threads, and open file descriptors."""

    seconds: float
    rounds: int
    memory: float
    threads: int
    files: int


def level(seconds: float, rounds: int) -> Level:
    """Read from /proc, after garbage is gone."""
    gc.collect()
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines() if ":" in line)
    memory = int(status["VmRSS"].split()[0]) / 1024
    return Level(seconds, rounds, memory, int(status["Threads"]), len(os.listdir("/proc/self/fd")))


def learn(index: int, folder: Path) -> None:
    """A data set, a model that learns from it, and its checkpoint, written and read."""
    scene = gn.load_scene(SYSTEMS[index % len(SYSTEMS)])
    trajectories = gn.collect_trajectories(scene, 12, 20, seed=index)
    model = gn.ForwardModel.for_scene(scene, hidden=HIDDEN[index % len(HIDDEN)], layers=1)
    predictor = model.bind(scene)
    gn.fit(predictor, trajectories, steps=20, progress=False)
    gn.evaluate_errors(predictor, trajectories, horizons=(10,))
    gn.save_checkpoint(folder / "model.safetensors", model, scene=scene)
    read = gn.load_pretrained(folder / "model.safetensors")
    with torch.no_grad():
        read.bind(scene).rollout(trajectories["state"][:, 0], trajectories["action"])


def plan(index: int, folder: Path) -> None:
    """Planners of two kinds through a snapshot of a packaged model, in a simulated and a batched environment."""
    pretrained = gn.load_pretrained("pendulum")
    scene = pretrained.scene()
    reward = gn.make_reward("balance", scene)
    true, model = gn.SceneEnv(scene, reward, seed=index), gn.ModelEnv(gn.specialize(pretrained.bind(scene)), reward)
    for planner in (
        gn.GradientPlanner(model, horizon=8, iterations=2, warm_up=3, seed=index),
        gn.ILQGPlanner(model, horizon=8, iterations=1, seed=index),
        gn.ILQGPlanner(true, horizon=8, iterations=1, seed=index),
    ):
        with torch.no_grad():
            start = true.reset(TensorDict(batch_size=[2]))
            true.rollout(4, planner, tensordict=start, auto_reset=False)


def differentiate(index: int, folder: Path) -> None:
    """Predictors of every size, live and specialised, refreshed, differentiated and dropped."""
    scene = gn.load_scene(SYSTEMS[index % len(SYSTEMS)])
    model = gn.ForwardModel.for_scene(scene, hidden=HIDDEN[index // 2 % len(HIDDEN)], layers=1)
    live = model.bind(scene)
    fast = gn.specialize(live)
    batch = (1, 7, 64, 600)[index % 4]
    trajectories = gn.collect_trajectories(scene, 2, 6, seed=index)
    rows = torch.arange(batch) % 2
    state, action = trajectories["state"][rows, 0], trajectories["action"][rows].requires_grad_()
    for predictor in (fast, live):
        states, _ = predictor.rollout(state, action)
        states.square().mean().backward()
    with torch.no_grad():
        next(model.parameters()).mul_(1.01)
    fast.refresh(live)


WORK: tuple[Callable[[int, Path], None], ...] = (learn, plan, differentiate)


def soak(minutes: float, report: Callable[[Level], None]) -> list[Level]:
    """Measure and report levels sixty times in ``minutes``."""
    levels: list[Level] = []
    start, rounds = time.monotonic(), 0
    with tempfile.TemporaryDirectory(prefix="soak") as folder:
        while True:
            seconds = time.monotonic() - start
            if seconds >= len(levels) * minutes:
                levels.append(level(seconds, rounds))
                report(levels[-1])
            if seconds >= 60 * minutes:
                return levels
            WORK[rounds % len(WORK)](rounds // len(WORK), Path(folder))
            rounds += 1


def growth(levels: list[Level]) -> dict[str, float]:
    """Return each quantity's growth: its minimum in the last twelfth over its minimum in the second twelfth."""
    part = max(1, len(levels) // 12)
    early, late = levels[part : 2 * part], levels[-part:]
    return {
        name: min(getattr(each, name) for each in late) / min(getattr(each, name) for each in early)
        for name in ("memory", "threads", "files")
    }


def parse(words: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--csv", type=Path, default=None, help="where the levels are written, as they come")
    return parser.parse_args(words)


def main() -> int:
    given = parse(sys.argv[1:])
    if given.csv is not None:
        given.csv.write_text("seconds,rounds,memory,threads,files\n")

    def show(each: Level) -> None:
        sizes = f"{each.memory:8.1f} MiB {each.threads:3} threads {each.files:3} files"
        sys.stdout.write(f"{each.seconds:6.0f} s {each.rounds:6} rounds {sizes}\n")
        sys.stdout.flush()
        if given.csv is not None:
            with given.csv.open("a", newline="") as file:
                csv.writer(file).writerow(
                    (f"{each.seconds:.0f}", each.rounds, f"{each.memory:.1f}", each.threads, each.files)
                )

    grown = growth(soak(given.minutes, show))
    sys.stdout.write(
        ", ".join(f"{name} {times:.3f}" for name, times in grown.items()) + " times as in the second twelfth\n"
    )
    return int(any(times > ALLOWED for times in grown.values()))


if __name__ == "__main__":
    sys.exit(main())
