"""Measure planners' reward against their planning time per step.

    python recipes/benchmarks/planning.py [system=cheetah] [iterations=[1,3,10,30]] ["checkpoints=[PATH, ...]"]
    python recipes/benchmarks/planning.py system=jaco episodes=1 steps=60 "baselines={ilqg: []}"

Runs the same episodes with increasing numbers of iterations per control step, for every model (of several hidden sizes,
say) and every baseline planner. Each is a run of recipes/mpc.py, one after the other. The same `run_dir` keeps finished
runs and resumes. No figure of the paper. Results: docs/results/planning-time.md.

Writes config.yaml, metrics.json, the table as table.md, the figure as curves.png, and each run with its log to its run
folder.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import hydra
from omegaconf import DictConfig

sys.path.append(str(Path(__file__).parents[1]))  # where _common is

from _common import as_list, clean_exit, open_log, with_help
from _common.sweeps import MPC, Run, folder_name, refuse_changes, report_sweep, run_all
from torchrl_gn.evaluation import plot_planning_curves
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import RunFolder


def make_runs(cfg: DictConfig, folder: Path) -> dict[str, dict[int, Run]]:
    """Return every model's and baseline's runs by number of iterations."""
    options = [f"{name}={cfg[name]}" for name in ("system", "episodes", "steps", "executor", "seed", "threads")]
    options += [f"simulation_threads={cfg.threads}", "video=false", *as_list(cfg.overrides)]
    models = as_list(cfg.checkpoints) or [None]
    ways = [("gn" if path is None else Path(path).stem, "gn", as_list(cfg.iterations), path) for path in models]
    # Baselines get the first model too: cem and mppi plan with it, and it identifies variants for all planners.
    ways += [(str(planner), str(planner), as_list(counts), models[0]) for planner, counts in cfg.baselines.items()]
    runs: dict[str, dict[int, Run]] = {}
    for label, planner, iterations, checkpoint in ways:
        if label in runs:
            raise ValueError(f"Two models or planners are called {label!r}; rename a run folder.")
        chosen = [*options, f"planner={planner}", *([] if checkpoint is None else [f"checkpoint={checkpoint}"])]
        key = f"{planner.removesuffix('_true')}.iterations"
        runs[label] = {}
        for count in iterations:
            place = folder / folder_name(label) / str(count)
            runs[label][count] = Run(MPC, place, (*chosen, f"{key}={count}"), f"{label}, {count} iterations")
    return runs


@with_help
@hydra.main(config_path="config", config_name="planning", version_base="1.3")
@clean_exit
def main(cfg: DictConfig) -> None:
    folder = RunFolder(cfg.run_dir, "benchmarks/planning")
    clock = 1e3 * load_scene(cfg.system).timestep
    runs = make_runs(cfg, folder.path)
    refuse_changes(run for group in runs.values() for run in group.values())
    tracker = open_log(cfg, folder, label=f"benchmarks/planning-{cfg.system}")
    failed = run_all([run for group in runs.values() for run in group.values()], jobs=1, desc="planning")

    metrics: dict[str, float] = {"clock_ms": clock}
    curves: dict[str, tuple[list[float], list[float], list[float]]] = {}
    lines = [
        f"| {cfg.system}, {cfg.episodes} x {cfg.steps} steps | iterations | mean reward of a step (higher is better) |"
        " std over starts | planning a step, ms | planning time / control step |",
        "|---" * 6 + "|",
    ]
    for label, group in runs.items():
        planner = label if label in cfg.baselines else "gn"
        times, rewards, stds = [], [], []
        for iterations, run in group.items():
            if not (found := run.numbers(math.nan)):  # NaN: the reward if every episode became unstable
                continue
            reward, std, ms = (found[f"{planner}/{key}"] for key in ("mean_reward", "mean_reward_std", "planning_ms"))
            for values, value in ((times, ms), (rewards, reward), (stds, std)):
                values.append(value)
            name = f"{label}/{iterations}"
            metrics |= {f"{name}/mean_reward": reward, f"{name}/mean_reward_std": std, f"{name}/planning_ms": ms}
            lines.append(f"| {label} | {iterations} | {reward:.4g} | {std:.2g} | {ms:,.0f} | {ms / clock:.2g} |")
        if times:
            curves[label] = (times, rewards, stds)
    if curves:
        plot_planning_curves(curves, folder.file("curves.png"))
    report_sweep(folder, lines, {}, metrics, failed, tracker, seed=cfg.seed)


if __name__ == "__main__":
    main()
