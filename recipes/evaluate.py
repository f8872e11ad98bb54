"""Evaluate a trained forward model or ensemble, on its own system or on another one.

    python recipes/evaluate.py checkpoint=runs/forward_model/<time> [system=swimmer8] [key=value ...]
    python recipes/evaluate.py checkpoint=swimmerN system=swimmer12
    python recipes/evaluate.py checkpoint=cheetah suite_task=cheetah/run

To compare models, evaluate each: runs with the same `system` and `seed` have the same test trajectories.

Collects fresh test trajectories, or pieces of a suite task's episodes under uniformly random actions. Prints the error
table (docs/evaluation.md defines the errors), and the joints' errors in metres and radians; for an ensemble, also how
many errors lie within its standard deviations. Takes seconds. All options: recipes/config/evaluate.yaml.

Writes config.yaml, metrics.json, a figure and a video to its run folder.
"""

from __future__ import annotations

import hydra
import numpy as np
import torch
from omegaconf import DictConfig
from tensordict import TensorDict

from _common import clean_exit, finish_run, open_run, with_help
from _common.training_data import HORIZON, collecting
from torchrl_gn.data import Simulator, collect_trajectories
from torchrl_gn.dynamics import Ensemble
from torchrl_gn.evaluation import joint_errors, report
from torchrl_gn.scenes import Scene, UnsupportedSceneError, load_scene, load_suite_task, require_bodies
from torchrl_gn.training import load_pretrained

EPISODE, PIECES = 1000, 5  # control steps of an episode, and pieces cut from each


def pieces_of_episodes(scene: Scene, name: str, count: int, length: int, seed: int) -> TensorDict:
    """Simulate a task's episodes under uniformly random actions; return ``count`` random pieces of ``length`` steps.

    Pieces of unstable episodes are left out.

    Raises:
        ValueError: if ``name`` is not a domain and task, or the task's joints or control step differ from the scene's.
    """
    domain, separator, task = name.partition("/")
    if not separator:
        raise ValueError(f"suite_task={name} must be a domain and a task, as in cheetah/run.")
    env = load_suite_task(domain, task, seed)
    joints = tuple(env.physics.model.id2name(joint, "joint") for joint in range(env.physics.model.njnt))
    if joints != scene.joint_names or not np.isclose(env.control_timestep(), scene.timestep):
        raise ValueError(
            f"suite_task={name} has joints {joints} and control steps of {env.control_timestep():g} s;"
            f" {scene.name!r} has {scene.joint_names} and {scene.timestep:g} s."
        )
    rng, episodes = np.random.default_rng(seed), -(-count // PIECES)
    starts = np.zeros((episodes, scene.physics_size))
    for start in starts:
        env.reset()
        start[1:] = env.physics.get_state()
    size = (episodes, EPISODE, scene.num_actions)
    actions = rng.uniform(scene.action_low, scene.action_high, size)
    played = Simulator(scene).rollout(starts, actions)
    begin = rng.integers(EPISODE - length + 1, size=count)
    which = torch.from_numpy(np.arange(count) // PIECES)[:, None]
    steps = torch.from_numpy(begin[:, None] + np.arange(length + 1))
    pieces = {"state": played["state"][which, steps], "action": torch.from_numpy(actions)[which, steps[:, :-1]]}
    return TensorDict(pieces, [count])[played["stable"][which[:, 0]]]


@with_help
@hydra.main(version_base=None, config_path="config", config_name="evaluate")
@clean_exit
def main(cfg: DictConfig) -> None:
    if cfg.checkpoint is None:
        raise ValueError("Say what to evaluate: checkpoint=runs/forward_model/<time>, or a trained model's name.")
    if not isinstance(cfg.checkpoint, str):
        raise ValueError(f"checkpoint={cfg.checkpoint} must be one model: run the recipe for each.")
    if cfg.timestep is not None and not cfg.system:
        raise ValueError(f"timestep={cfg.timestep} is for another system: pass system=, too.")
    checkpoint = load_pretrained(cfg.checkpoint)
    scene = (
        load_scene(cfg.system, timestep=cfg.timestep)
        if cfg.system
        else require_bodies(checkpoint.scene(), "recipes/evaluate.py")
    )
    trained = checkpoint.ensemble if isinstance(checkpoint.trained, Ensemble) else checkpoint.model
    model = trained.bind(scene, strict=cfg.strict)
    if cfg.length < HORIZON:
        raise ValueError(f"length={cfg.length} is too short: errors are measured over {HORIZON} steps.")
    torch.set_num_threads(cfg.threads)
    run, tracker = open_run(cfg, "evaluate")
    if cfg.suite_task:
        test = pieces_of_episodes(scene, cfg.suite_task, cfg.sequences, cfg.length, cfg.seed)
    else:
        with collecting("test data") as show:
            test = collect_trajectories(scene, cfg.sequences, cfg.length, cfg.seed, split=3, progress=show)
    table, files = report(model, test, run.path)
    print(table)
    metrics = table.to_metrics()
    try:
        joints = joint_errors(model, test)
    except UnsupportedSceneError as error:
        print(error)
    else:
        print(f"\nJoints, over {cfg.length} steps:\n{joints}")
        metrics |= joints.to_metrics()
    finish_run(cfg, run, tracker, metrics, files=files)


if __name__ == "__main__":
    main()
