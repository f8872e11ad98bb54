"""Let a model learn from what planning with it meets.

    python recipes/plan_and_learn.py [system=cheetah] [rounds=3] [key=value ...]

A planner takes a system where random control never does, and there the model that it plans with was never right. Here
episodes are planned and played (recipes/mpc.py), the model learns on, with them as half of its data
(recipes/forward_model.py start_from=... data.extra=...), and plays again; every round from new starts. Finished rounds
are kept; the same run_dir goes on, with more rounds too. What came out: docs/results.md.

Writes config.yaml, metrics.json, the table as table.md, rewards over time as rewards.png, and each round's episodes and
model with their logs to its run folder. All options: recipes/config/plan_and_learn.yaml.
"""

from __future__ import annotations

from pathlib import Path

import hydra
from omegaconf import DictConfig, OmegaConf
from safetensors.torch import load_file

from torchrl_gn.evaluation import plot_rewards
from torchrl_gn.pretrained import load_model
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import RunFolder, Tracker, clean_exit, with_help
from torchrl_gn.training.sweep import Run, report_sweep, run_all

RECIPES = Path(__file__).parent


def playing(cfg: DictConfig, folder: Path, index: int, model: str) -> Run:
    """Episodes planned through a model."""
    options = (f"system={cfg.system}", f"episodes={cfg.episodes}", f"steps={cfg.steps}", f"compile={cfg.compile}")
    options += (f"checkpoint={model}", f"seed={cfg.seed + index}", f"threads={cfg.threads}")
    options += ("video=false", "gn.iterations=3", *cfg.planning)
    return Run(RECIPES / "mpc.py", folder / f"played{index}", options, f"playing, round {index}")


def learning(cfg: DictConfig, folder: Path, index: int, model: str, played: list[Run]) -> Run:
    """A training that goes on from a model, with episodes as half of its data."""
    extra = ",".join(str(run.folder / "gn.safetensors") for run in played)
    options = (f"system={cfg.system}", f"start_from={model}", f"data.extra=[{extra}]", f"minutes={cfg.minutes}")
    options += (f"clock={cfg.clock}", f"lr={cfg.lr}", f"seed={cfg.seed + index}", f"threads={cfg.threads}")
    options += (f"data.folder={folder / 'data' if cfg.data_dir is None else cfg.data_dir}", *cfg.training)
    return Run(RECIPES / "forward_model.py", folder / f"learned{index}", options, f"learning, round {index}")


@with_help
@hydra.main(config_path="config", config_name="plan_and_learn", version_base="1.3")
@clean_exit
def main(cfg: DictConfig) -> None:
    folder = RunFolder(cfg.run_dir, "plan_and_learn")
    model = cfg.checkpoint or cfg.system
    load_model(model)  # refused before anything is written
    folder.write_config(OmegaConf.to_yaml(cfg, resolve=True))
    tracker = Tracker(cfg.logger, folder.path / "log", name="plan_and_learn", config=cfg)
    place = folder.path.resolve()  # named in the rounds' options, which may not change
    lines = ["| round | mean reward (spread over starts) | ms a step | one-step error | 100 steps |", "|---" * 5 + "|"]
    metrics: dict[str, float] = {}
    played: list[Run] = []
    failed: list[Run] = []
    for index in range(cfg.rounds + 1):
        errors = ["", ""]
        if index:
            learned = learning(cfg, place, index, model, played)
            failed = run_all([learned], 1, desc=learned.name)
            if failed or learned.metrics is None:
                break
            model = str(learned.folder)
            found = {name: learned.metrics[name] for name in ("one_step_error", "rollout_error_100")}
            metrics |= {f"round {index}/{name}": value for name, value in found.items()}
            errors = [f"{value:.1e}" for value in found.values()]
        played.append(playing(cfg, place, index, model))
        failed = run_all(played[-1:], 1, desc=played[-1].name)
        values = played[-1].metrics
        if failed or values is None:
            break
        metrics |= {f"round {index}/{name.removeprefix('gn/')}": values[name] for name in values if "gn/" in name}
        reward = f"{values['gn/mean_reward']:.3g} ({values['gn/mean_reward_std']:.2g})"
        lines.append(f"| {index} | {reward} | {values['gn/planning_ms']:.0f} | " + " | ".join(errors) + " |")
    kept = [run for run in played if run.metrics is not None]
    rewards = [load_file(run.folder / "gn.safetensors")["reward"] for run in kept]
    if rewards:
        curves = {f"round {index}": values for index, values in enumerate(rewards)}
        plot_rewards(curves, folder.file("rewards.png"), timestep=load_scene(cfg.system).timestep, ylabel="reward")
    report_sweep(folder, lines, {}, metrics, failed, tracker, seed=cfg.seed)


if __name__ == "__main__":
    main()
