"""Train a model on episodes planned with it, round by round.

    python recipes/plan_and_learn.py [system=cheetah] [rounds=3] [key=value ...]

A planner drives a system into states that random control never reaches; there the learned model is wrong. This recipe
runs planned episodes (recipes/mpc.py), trains the model further with them as half of its data (recipes/forward_model.py
start_from=... data.extra=...), and plans again; every round from new starts. Finished rounds are kept; the same run_dir
goes on, with more rounds too. No figure of the paper. Results: docs/results.md.

Writes config.yaml, metrics.json, the table as table.md, rewards over time as rewards.png, and each round's episodes
(executed<round>) and model (learned<round>) with their logs to its run folder. All options:
recipes/config/plan_and_learn.yaml.
"""

from __future__ import annotations

import math
from pathlib import Path

import hydra
from omegaconf import DictConfig
from safetensors.torch import load_file

from _common import as_list, clean_exit, open_log, with_help
from _common.sweeps import FORWARD_MODEL, MPC, Run, refuse_changes, report_sweep, run_all
from torchrl_gn.evaluation import plot_rewards
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import RunFolder, load_pretrained


def planning(cfg: DictConfig, folder: Path, index: int, model: str) -> Run:
    """Episodes executed through a model."""
    options = (f"system={cfg.system}", f"episodes={cfg.episodes}", f"steps={cfg.steps}", f"executor={cfg.executor}")
    options += (f"checkpoint={model}", f"seed={cfg.seed + index}", f"threads={cfg.threads}")
    options += ("video=false", "gn.iterations=3", *as_list(cfg.planning))
    return Run(MPC, folder / f"executed{index}", options, f"planning, round {index}")


def learning(cfg: DictConfig, folder: Path, index: int, model: str, executed: list[Run]) -> Run:
    """A training that goes on from a model, with episodes as half of its data."""
    extra = ",".join(str(run.folder / "gn.safetensors") for run in executed)
    options = (f"system={cfg.system}", f"start_from={model}", f"data.extra=[{extra}]")
    options += ("steps=null", f"minutes={cfg.minutes}")
    options += (f"clock={cfg.clock}", f"lr={cfg.lr}", f"seed={cfg.seed + index}", f"threads={cfg.threads}")
    options += (f"data.folder={folder / 'data' if cfg.data_dir is None else cfg.data_dir}", *as_list(cfg.training))
    return Run(FORWARD_MODEL, folder / f"learned{index}", options, f"learning, round {index}")


def make_runs(cfg: DictConfig, folder: Path, model: str) -> tuple[list[Run], list[Run]]:
    """Every round's learning, of which the first has none, and planned episodes."""
    learned: list[Run] = []
    executed = [planning(cfg, folder, 0, model)]
    for index in range(1, cfg.rounds + 1):
        learned.append(learning(cfg, folder, index, model, executed))
        model = str(learned[-1].folder)
        executed.append(planning(cfg, folder, index, model))
    return learned, executed


@with_help
@hydra.main(config_path="config", config_name="plan_and_learn", version_base="1.3")
@clean_exit
def main(cfg: DictConfig) -> None:
    folder = RunFolder(cfg.run_dir, "plan_and_learn")
    model = cfg.checkpoint or cfg.system
    load_pretrained(model)  # refused before anything is written
    learned, executed = make_runs(cfg, folder.path.resolve(), model)  # named in the options, which may not change
    refuse_changes([*learned, *executed])
    tracker = open_log(cfg, folder)
    lines = ["| round | mean reward (std over starts) | ms a step | one-step error | 100 steps |", "|---" * 5 + "|"]
    metrics: dict[str, float] = {}
    failed: list[Run] = []
    for index, execution in enumerate(executed):
        errors = {}
        if index:
            learn = learned[index - 1]
            failed = run_all([learn], 1, desc=learn.name)
            if failed:
                break
            measured = learn.numbers()
            errors = {name: measured[name] for name in ("one_step_error", "rollout_error_100")}
            metrics |= {f"round {index}/{name}": value for name, value in errors.items()}
        failed = run_all([execution], 1, desc=execution.name)
        if failed:
            break
        measured = execution.numbers(math.nan)  # not one: a reward where every episode became unstable
        found = {name.removeprefix("gn/"): value for name, value in measured.items() if name.startswith("gn/")}
        metrics |= {f"round {index}/{name}": value for name, value in found.items()}
        reward = f"{found['mean_reward']:.3g} ({found['mean_reward_std']:.2g})"
        cells = [f"{value:.1e}" for value in errors.values()] or ["", ""]
        lines.append(f"| {index} | {reward} | {found['planning_ms']:.0f} | " + " | ".join(cells) + " |")
    kept = [run for run in executed if run.metrics is not None]
    rewards = [load_file(run.folder / "gn.safetensors")["reward"] for run in kept]
    if rewards:
        curves = {f"round {index}": values for index, values in enumerate(rewards)}
        plot_rewards(curves, folder.file("rewards.png"), timestep=load_scene(cfg.system).timestep, ylabel="reward")
    report_sweep(folder, lines, {}, metrics, failed, tracker, seed=cfg.seed)


if __name__ == "__main__":
    main()
