"""A task of the control suite in rounds of an actor-critic: played by dm_control, its reward known or learned."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, cast

import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from _common.actor_critic import play, unbroken, windows
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
    frame = load_scene(system)
    scene = load_scene(system, timestep=cfg.action_repeat * frame.timestep)
    return SuiteTask(cfg, scene, frame if cfg.per_frame else scene, "" if alone else scene.name)


class SuiteTask(Task):
    """A task of the suite, whose policy is judged by what dm_control pays.

    The policy and value are of the control steps of ``scene``, the model and the reward of those of ``modelled``: of
    one frame, say, as what a body does in contact is predicted the worse the longer the step.
    """

    def __init__(self, cfg: DictConfig, scene: Scene, modelled: Scene, folder: str) -> None:
        self.learns_reward, name = cfg.reward == LEARNED, scene.origin["suite"]
        recenter, yaw = hidden_by_task(*name.split("/"))
        hidden = Canonicalizer(recenter=recenter, yaw=yaw)
        if self.learns_reward:
            reward = StateReward(modelled, hidden=cfg.hidden, canonicalizer=hidden, target=has_target(name))
        else:
            reward = reward_of(cfg, modelled)
        super().__init__(cfg, scene, reward, reward, folder, modelled=modelled, invariances=hidden)
        given = {"steps": cfg.steps, "first.length": cfg.first.length, "evaluate.steps": cfg.evaluate.steps}
        for option, steps in given.items():
            if steps is not None and steps > (longest := self._judged.steps):
                raise ValueError(f"{option}={steps}: an episode of suite:{name} has {longest} control steps.")

    @cached_property
    def _played(self) -> SuiteTaskEnv:
        return SuiteTaskEnv(self.scene, num_envs=self.cfg.episodes, frames=self.cfg.per_frame)

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
        env = SuiteTaskEnv(self.scene, frames=self.cfg.per_frame, seed=self.cfg.seed)
        controls = spline_controls(self.scene, first.trajectories, first.length, self.cfg.seed)
        for sequence in torch.from_numpy(controls).float():
            found.append(play(env, _replay(sequence), episodes=1, steps=first.length, explore=False))
        return self._windows(cast(TensorDict, torch.cat(found)))

    def play(self, policy: BoundedPolicy, seed: int) -> TensorDict:
        self._played.set_seed(seed)
        sizes = {"episodes": self.cfg.episodes, "steps": self.cfg.steps}
        return self._windows(play(self._played, policy, **sizes, explore=True))

    def _windows(self, played: TensorDict) -> TensorDict:
        """Trajectories of the model's steps."""
        played = unbroken(played)
        if self.cfg.per_frame:
            state, paid = (played["next", name].flatten(1, 2) for name in ("frames", "paid"))
        else:
            state, paid = played["next", "state"], played["next", "reward"]
        state = torch.cat((played["state"][:, :1], state), 1)
        action = played["action"].repeat_interleave(self.model_steps, 1)
        target = played["target"][:, 0] if self.targeted else None
        return windows(state, action, paid if self.learns_reward else None, target)

    def judged(self, policy: BoundedPolicy) -> TensorDict:
        self._judged.set_seed(10_000)
        sizes = {"episodes": self.cfg.evaluate.episodes, "steps": self.cfg.evaluate.steps or self._judged.steps}
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
