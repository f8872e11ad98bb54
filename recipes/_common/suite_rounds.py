"""A task of the control suite in rounds of an actor-critic: played by dm_control, its reward known or learned."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, cast

import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from _common.actor_critic import play, played_windows
from _common.actor_critic_rounds import Round, Task
from _common.planning_task import reward_of
from torchrl_gn.data import spline_controls
from torchrl_gn.dynamics import Canonicalizer
from torchrl_gn.envs import SuiteTaskEnv
from torchrl_gn.planners import BoundedPolicy, StateReward
from torchrl_gn.scenes import Scene, has_target, hidden_by_task, load_scene
from torchrl_gn.training import fit_reward, load_pretrained

LEARNED = "learned"


def suite_task(cfg: DictConfig, system: str, *, alone: bool = True) -> SuiteTask:
    """The task of a ``system`` such as ``suite:cheetah/run``; ValueError if options are those of other systems."""
    for name in ("timestep", "judged_reward", "action_bounds"):
        if cfg[name] is not None:
            raise ValueError(f"{name}={cfg[name]}: {system} has its own; action_repeat= makes control steps longer.")
    if cfg.target_squares:
        raise ValueError(f"target_squares={list(cfg.target_squares)}: {system} has starts of its own.")
    scene = load_scene(system, timestep=cfg.action_repeat * load_scene(system).timestep)
    return SuiteTask(cfg, scene, "" if alone else scene.name)


class SuiteTask(Task):
    """A task of the suite, whose policy is judged by what dm_control pays."""

    def __init__(self, cfg: DictConfig, scene: Scene, folder: str) -> None:
        self.learns_reward = cfg.reward == LEARNED
        if self.learns_reward:
            target = has_target(scene.origin["suite"])
            reward = StateReward(scene, hidden=cfg.hidden, canonicalizer=_hidden(scene), target=target)
        else:
            reward = reward_of(cfg, scene)
        super().__init__(cfg, scene, reward, reward, folder)

    def _invariances(self) -> Canonicalizer:
        return _hidden(self.scene)

    @cached_property
    def _played(self) -> SuiteTaskEnv:
        return SuiteTaskEnv(self.scene, num_envs=self.cfg.episodes)

    @cached_property
    def _judged(self) -> SuiteTaskEnv:
        return SuiteTaskEnv(self.scene, num_envs=self.cfg.evaluate.episodes)

    def begin(self, policy: BoundedPolicy, begun: Round | None) -> None:
        if self.learns_reward:
            if begun is not None:
                self.reward = load_pretrained(begun.of("reward", self)).reward
            self.reward.to(self.device)
        super().begin(policy, begun)

    def play_at_random(self) -> TensorDict:
        first, found = self.cfg.first, []
        env = SuiteTaskEnv(self.scene, seed=self.cfg.seed)
        controls = spline_controls(self.scene, first.trajectories, first.length, self.cfg.seed)
        for sequence in torch.from_numpy(controls).float():
            found.append(play(env, _replay(sequence), episodes=1, steps=first.length, explore=False))
        return played_windows(cast(TensorDict, torch.cat(found)), rewards=self.learns_reward)

    def play(self, policy: BoundedPolicy, seed: int) -> TensorDict:
        self._played.set_seed(seed)
        played = play(self._played, policy, episodes=self.cfg.episodes, steps=self.cfg.steps, explore=True)
        return played_windows(played, rewards=self.learns_reward)

    def judged(self, policy: BoundedPolicy) -> TensorDict:
        self._judged.set_seed(10_000)
        sizes = {"episodes": self.cfg.evaluate.episodes, "steps": self.cfg.evaluate.steps}
        played = play(self._judged, policy, **sizes, explore=False)
        played["next", "reward"] = cast(Tensor, played["next", "reward"]) / self.cfg.action_repeat
        return played

    def learn_reward(self, data: TensorDict, index: int) -> None:
        if self.learns_reward:
            steps = self.cfg.reward_steps * (3 if index == 0 else 1)
            fit_reward(cast(StateReward, self.reward), data, steps=steps, seed=self.cfg.seed + index)

    @property
    def networks(self) -> dict[str, Any]:
        learned = {"reward": self.reward} if self.learns_reward else {}
        return {**super().networks, **learned}


def _replay(actions: Tensor) -> Callable[[TensorDictBase], TensorDictBase]:
    """A policy that gives ``actions`` ``[T, A]`` one after another."""
    rest = iter(actions.unsqueeze(1))
    return lambda tensordict: tensordict.set("action", next(rest))


def _hidden(scene: Scene) -> Canonicalizer:
    recenter, yaw = hidden_by_task(*scene.origin["suite"].split("/"))
    return Canonicalizer(recenter=recenter, yaw=yaw)
