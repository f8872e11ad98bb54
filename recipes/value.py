"""Learn a value of states, and a policy that imitates the planner, from planned episodes.

    python recipes/value.py "episodes=[runs/mpc/<time>/gn.safetensors]" [key=value ...]

Reads episodes of recipes/mpc.py, all of one system and reward, and learns the discounted return that follows each
state, by TD(lambda). `recipes/mpc.py value=RUN` adds the value of the state in which a plan ends; `policy=RUN` starts
plans from the policy. recipes/plan_and_learn.py learns both after every round (value=true, policy=true). No figure of
the paper.

Writes config.yaml, metrics.json, the value (checkpoint/), the policy (policy.safetensors) and value.png, which compares
the values of the last file's states with the discounted returns that followed. The same command gives the same numbers
bit for bit; an interrupted run starts over. All options: recipes/config/value.yaml. Results:
docs/results/terminal-value.md.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict
from torch import Tensor

from _common import clean_exit, finish_run, open_log, read_config, refuse_other_options, scene_options, with_help
from _common.episodes import transitions
from _common.options import SCENE_OPTIONS
from _common.planning_task import reward_of
from torchrl_gn.evaluation import plot_rewards
from torchrl_gn.policies import StatePolicy, StateValue, task_invariances
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import RunFolder, fit_policy, fit_value, plain_config, save_checkpoint
from torchrl_gn.training.run_folder import CONFIG_FILE

TASK = ("system", *SCENE_OPTIONS, "reward")  # options that define the task of an episode


def task_of(files: list[Path]) -> DictConfig:
    """Return system and reward of episodes, from the ``config.yaml`` beside each file; ValueError if they differ."""
    tasks = []
    for file in files:
        if not file.is_file() or not (config := file.with_name(CONFIG_FILE)).exists():
            raise ValueError(
                f"episodes={file} must be a file in a run folder of recipes/mpc.py, with its {CONFIG_FILE}."
            )
        played = read_config(config)
        tasks.append({key: played[key] for key in TASK})
        if played.variants:
            raise ValueError(f"episodes={file} are of variants, which a value of states cannot tell apart.")
        if changed := [key for key in TASK if tasks[-1][key] != tasks[0][key]]:
            raise ValueError(f"episodes={file} has another {changed[0]} than {files[0]}; learn a value of each.")
    return cast(DictConfig, OmegaConf.create(tasks[0]))


def following(value: StateValue, played: TensorDict) -> tuple[Tensor, Tensor]:
    """Return values ``[M, T]`` of episodes' states, and the discounted returns that followed, up to the last value."""
    with torch.no_grad():
        predicted, last = value(played["state"]), value(played["next", "state"][:, -1])
    total, totals = last, []
    for reward in reversed(played["next", "reward"].unbind(1)):
        total = reward + value.discount * total
        totals.append(total)
    return predicted.squeeze(-1), torch.stack(totals[::-1], dim=1).squeeze(-1)


@with_help
@hydra.main(version_base=None, config_path="config", config_name="value")
@clean_exit
def main(cfg: DictConfig) -> None:
    if not cfg.episodes:
        raise ValueError('Name episodes of recipes/mpc.py: "episodes=[runs/mpc/<time>/gn.safetensors]".')
    torch.manual_seed(cfg.seed)
    torch.set_num_threads(cfg.threads)
    files = [Path(file) for file in cfg.episodes]
    task = task_of(files)
    scene = load_scene(task.system, **scene_options(task))
    reward = reward_of(task, scene)
    if reward.target_shape is not None:
        raise ValueError(f"A value of states does not know the target of {reward}.")
    played = [part for file in files for part in transitions(file)]
    run = RunFolder(cfg.run_dir, "value")
    refuse_other_options(cfg, run, ("threads", "logger", "run_dir"))
    tracker = open_log(cfg, run)

    canonicalizer, options = task_invariances(scene, reward), plain_config(cfg)
    config = {**options, **plain_config(task)}
    value = StateValue(
        scene, discount=cfg.discount, hidden=cfg.hidden, members=cfg.members, canonicalizer=canonicalizer
    )
    learned = fit_value(value, played, seed=cfg.seed, **options["fit"])
    metrics: dict[str, Any] = {"explained": learned.explained, "steps": sum(part.numel() for part in played)}
    predicted, followed = following(value, played[-1])
    metrics |= {"value": predicted.mean().item(), "return": followed.mean().item()}
    save_checkpoint(run.checkpoint, value, scene=scene, config=config, metrics=metrics)
    checkpoints = [run.checkpoint]
    if scene.num_actions and not scene.unbounded:
        policy = StatePolicy(scene, hidden=cfg.hidden, canonicalizer=canonicalizer)
        metrics["imitation_error"] = fit_policy(policy, played, seed=cfg.seed, **options["imitate"]).losses[-1]
        checkpoints.append(run.path / "policy.safetensors")
        save_checkpoint(checkpoints[-1], policy, scene=scene, config=config)
    curves = {"learned value": predicted, "return that followed": followed}
    plot_rewards(curves, run.file("value.png"), timestep=scene.timestep, ylabel=f"value (discount {cfg.discount:g})")
    print(f"The value explains {learned.explained:.1%} of the variance of its targets (100 %: all of it).")
    finish_run(cfg, run, tracker, metrics, checkpoints=checkpoints)


if __name__ == "__main__":
    main()
