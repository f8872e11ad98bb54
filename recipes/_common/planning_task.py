"""The task of a planning recipe: its options, scenes, model, start states and targets."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from _common import load_system
from torchrl_gn.checks import check_count
from torchrl_gn.data import Simulator, UnstableSimulationError, sample_start_states, spline_controls
from torchrl_gn.dynamics import specialize
from torchrl_gn.envs import SceneEnv
from torchrl_gn.identification import IdentifyingModel
from torchrl_gn.planners import TerminalReward
from torchrl_gn.policies import BoundedPolicy, StateValue
from torchrl_gn.rewards import Reward, make_reward
from torchrl_gn.scenes import Scene, sample_variants
from torchrl_gn.training import load_pretrained, plain_config, pretrained_names

ON_MODEL = "gn", "sampling", "ilqr", "cem", "mppi"
ON_PHYSICS = "ilqg", "cem_true", "mppi_true", "policy", "random", "nothing"


def fill_in(cfg: DictConfig) -> None:
    """Replace null options by the paper's options for the system's task, and check them."""
    name = re.sub(r"\d+$", "", cfg.system) if cfg.system.startswith("swimmer") else cfg.system
    task = cfg.tasks.get(name, {})
    if not task and (isinstance(cfg.reward, str) or None in (cfg.reward, cfg.horizon, cfg.steps)):
        raise ValueError(
            f"{cfg.system!r} is not a system of the paper, whose tasks this recipe has ({list(cfg.tasks)}). For another"
            " robot give its task: reward='[{type: Velocity, body: torso, axis: x}]' (docs/planning.md, 'Plan for your"
            " own robot'), horizon=20 and steps=200, say."
        )
    defaults = [
        (cfg, "reward", task.get("rewards", [None])[0]),
        (cfg, "horizon", task.get("horizon")),
        (cfg, "steps", task.get("steps")),
        (cfg.gn, "iterations", task.get("iterations", 3)),
    ]
    for part, key, value in defaults:
        if part[key] is None:
            part[key] = value
    for key in ("horizon", "steps", "episodes", "context_length", "threads"):
        check_count(key, cfg[key], 1)
    with open_dict(cfg):  # else a change to another system's task would change this run's options
        del cfg.tasks
    if not isinstance(cfg.planner, ListConfig):
        cfg.planner = [cfg.planner]
    unknown = [name for name in cfg.planner if name not in ON_MODEL + ON_PHYSICS]
    if unknown:
        raise ValueError(f"There is no planner {unknown[0]!r}; use some of {[*ON_MODEL, *ON_PHYSICS]}.")
    if "policy" in cfg.planner and cfg.policy is None:
        raise ValueError("planner=policy acts by a learned policy: pass policy=PATH, a run of recipes/shac.py, say.")


def make_scenes(cfg: DictConfig) -> tuple[Scene, list[Scene]]:
    """Load the standard scene, and with ``variants=true`` a random variant for every episode."""
    scene = load_system(cfg, cfg.system)
    if not cfg.variants:
        return scene, [scene]
    rng = np.random.default_rng(np.random.SeedSequence(cfg.seed, spawn_key=(2,)))
    return scene, sample_variants(cfg.system, cfg.episodes, rng)


def shipped_models(cfg: DictConfig) -> list[str]:
    """Return the names of the package's models of the system, or of its variants."""
    fitting = [cfg.system, re.sub(r"^swimmer\d+$", "swimmerN", cfg.system)]
    if cfg.variants:
        fitting = [f"identified_{cfg.system}"]
    return [name for name in fitting if name in pretrained_names()]


def bind_model(cfg: DictConfig, scene: Scene):
    """Load the trained model, specialised for the scene; return it and its inference model, or None."""
    names = shipped_models(cfg)
    if cfg.checkpoint is None and not names:
        what = f"variants of {cfg.system!r}" if cfg.variants else repr(cfg.system)
        raise ValueError(f"No trained model of {what} comes with the package; pass checkpoint=PATH.")
    checkpoint = load_pretrained(cfg.checkpoint or names[0])
    if isinstance(checkpoint.trained, IdentifyingModel):
        bound, inference = checkpoint.trained.bind(scene)
        return specialize(bound, executor=cfg.executor), inference
    if cfg.variants and not checkpoint.config.get("parametrized"):
        raise ValueError("The model was trained on one system, not on variants: pass checkpoint=PATH of one that was.")
    bound = checkpoint.model.bind(scene, parameters_key="parameters" if cfg.variants else None)
    return specialize(bound, executor=cfg.executor), None


def load_terminal(cfg: DictConfig, reward: Reward, scene: Scene) -> StateValue | TerminalReward | None:
    """Return the value of the states in which plans end; ValueError if it was learned for another reward."""
    if cfg.terminal_weight is not None:
        if cfg.value is not None:
            raise ValueError("Pass value= or terminal_weight=, not both.")
        return TerminalReward(reward, scene, cfg.terminal_weight)
    if cfg.value is None:
        return None
    checkpoint = load_pretrained(_file_of(cfg.value, "value"))
    value, learned_for = checkpoint.value, checkpoint.config.get("reward")
    if learned_for is not None and learned_for != plain_config(cfg)["reward"]:
        raise ValueError(f"value={cfg.value} was learned for the reward {learned_for}, not {cfg.reward}.")
    if reward.target_shape is not None:
        raise ValueError(f"value={cfg.value}: a value of states does not know the target of {reward}.")
    return value


def load_policy(cfg: DictConfig, scene: Scene) -> BoundedPolicy | None:
    """Return the policy that proposes plans; ValueError if it cannot drive the scene."""
    if cfg.policy is None:
        return None
    policy = load_pretrained(_file_of(cfg.policy, "policy")).policy
    try:
        return policy.for_scene(scene)
    except ValueError as error:
        raise ValueError(f"policy={cfg.policy}: {error}") from None


def _file_of(path: str, what: str) -> str | Path:
    """Return the file of a network that a run folder keeps beside its checkpoint, else the path itself."""
    file = Path(path) / f"{what}.safetensors"
    return file if file.exists() else path


def reward_of(cfg: DictConfig, scene: Scene, key: str = "reward") -> Reward:
    """Return the task's reward: by name, from terms, or the suite's own."""
    named = cfg[key] is None or isinstance(cfg[key], str)
    return make_reward(cfg[key] if named else cast(Any, OmegaConf.to_container(cfg[key])), scene)


def draw_targets(cfg: DictConfig, reward: Reward, scene: Scene, state: Tensor) -> Tensor | None:
    """Draw every episode's target: a position for a swimmer's head, a random pose for an arm, or None."""
    if reward.target_shape is None:
        return None
    rng, count = np.random.default_rng(np.random.SeedSequence(cfg.seed, spawn_key=(1,))), len(state)
    if reward.target_shape == (3,):
        angle = torch.from_numpy(rng.uniform(-np.pi, np.pi, count))
        way = torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), dim=-1)
        return state[:, 1, :3] + cfg.target_distance * way
    return Simulator(scene).observe(sample_start_states(scene, count, rng))


def start_states(cfg: DictConfig, env: SceneEnv, bound, inference) -> TensorDictBase:
    """Return start states with each system's physical parameters: true, or identified from random controls."""
    now = env.reset(TensorDict(batch_size=[cfg.episodes])).exclude("done", "terminated")
    if inference is not None:
        controls = torch.from_numpy(spline_controls(env.scene, cfg.episodes, cfg.context_length, cfg.seed + 1))
        simulated = env.simulator.rollout(now["physics"], controls)  # scenes in turn, as in reset
        unstable = int((~simulated["stable"]).sum())
        if unstable:
            raise UnstableSimulationError(
                f"{unstable} of {cfg.episodes} simulations became unstable under the {cfg.context_length} random"
                " controls that a system is identified from; try another seed, or a smaller context_length."
            )
        now.update({key: simulated[key][:, -1] for key in ("state", "physics")})
        with torch.no_grad():
            now["parameters"] = inference.identify(simulated["state"], controls)
    elif bound is not None and bound.parameters_key is not None:
        now["parameters"] = torch.stack([bound.parameters_of(scene) for scene in env.scenes])
    return now
