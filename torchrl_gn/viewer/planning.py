"""A planner at work in a live world: the action it chooses, and the states that it plans."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_gn.checks import checked_seed
from torchrl_gn.data import Simulator, sample_start_states
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.planners import GradientPlanner, ILQGPlanner
from torchrl_gn.rewards import FreezeGoal, Reward, available_rewards, make_reward
from torchrl_gn.scenes import Scene
from torchrl_gn.viewer.world import Model

SUITE_TASK = "task of the suite"
# Control steps planned ahead: the paper's (SM "Planning configuration"), fewer for slow systems, as visitors wait.
_HORIZONS = {"pendulum": 50, "cartpole": 50, "acrobot": 100, "swimmerN": 50, "cheetah": 20, "walker2d": 20, "jaco": 20}
_ITERATIONS = 3  # a step
_SECONDS = 0.4  # planned ahead for other scenes
_FIRST_PLAN = 40  # iterations
_TARGET = 1.0  # metres from the first body to a target, in a random direction


def tasks_of(scene: Scene) -> tuple[str, ...]:
    """Return the names of the tasks that the library has for a scene; empty if there are none."""
    if "suite" in scene.origin:
        try:
            make_reward(None, scene)
        except ValueError:  # no differentiable reward of this task
            return ()
        return (SUITE_TASK,)
    system = _system(scene)
    names = tuple(task for owner, task in available_rewards() if owner == system)
    first = {"cheetah": "forward", "walker2d": "forward", "pendulum": "balance", "acrobot": "swing_up"}.get(system)
    return tuple(sorted(names, key=lambda name: name != first)) if first in names else names


class LivePlanner:
    """MPC for one task: gradients through the model or, without one, iLQG on the true physics.

    Args:
        task: one of :func:`tasks_of`.
        seed: seed of the planner and the targets.

    Raises:
        ValueError: if there is no such task, or the scene's actions have no bounds.
    """

    def __init__(self, scene: Scene, model: Model | None, task: str, *, seed: int = 0) -> None:
        self.scene, self.task = scene, task
        self.reward: Reward = make_reward(None if task == SUITE_TASK else task, scene)
        horizon = _HORIZONS.get(_system(scene), int(np.clip(_SECONDS / scene.timestep, 10, 50)))
        self._planner: Any
        self._ahead: Callable[[TensorDictBase, Tensor], Tensor]
        if model is None:
            env = SceneEnv(scene, self.reward, num_threads=1, seed=seed)
            self._planner = ILQGPlanner(env, horizon, iterations=1, warm_up=5, seed=seed, num_threads=1)
            self._ahead = lambda now, actions: env.simulator.rollout(now["physics"], actions)["state"]
        else:
            imagined = ModelEnv(model, self.reward)
            adam = partial(torch.optim.Adam, lr=0.1)
            options: dict[str, Any] = {"warm_up": _FIRST_PLAN, "optimizer": adam, "seed": seed}
            self._planner = GradientPlanner(imagined, horizon, _ITERATIONS, **options)
            self._ahead = lambda now, actions: imagined.imagine(now, actions)[0]
        self._rng, self._simulator = np.random.default_rng(checked_seed(seed)), Simulator(scene, 1)
        self._carried: dict[Any, Any] = {}  # plan, and entries that a model carries from step to step
        self.target: Tensor | None = None

    def begin(self, state: Tensor) -> None:
        """Forget the plan, and draw a target if the task has one, for an episode from ``state`` ``[N, C]``."""
        self._carried, self.target = {}, None
        if self.reward.target_shape == (3,):
            angle = self._rng.uniform(-np.pi, np.pi)
            self.target = state[1, :3] + _TARGET * torch.tensor([np.cos(angle), np.sin(angle), 0.0])
        elif self.reward.target_shape is not None:
            self.target = self._simulator.observe(sample_start_states(self.scene, 1, self._rng))[0, :, :13]

    @torch.no_grad()
    def act(self, physics: np.ndarray, state: Tensor) -> tuple[np.ndarray, np.ndarray]:
        """Return the action ``[A]`` for a state, and the states ``[H + 1, N, C]`` that its plan leads through."""
        entries = {"state": state[None], "physics": torch.from_numpy(physics)[None]}
        now = TensorDict(entries, batch_size=[1])
        for key, value in self._carried.items():
            now.set(key, value)
        if self.target is not None:
            now = FreezeGoal(self.reward)(now.set("target", self.target[None]))
        before = now.copy()
        after = self._planner(now)
        left = cast(Tensor, after["plan", "actions"])
        left = left if left.ndim == 3 else left[:, 0]  # the best candidate
        action = cast(Tensor, after["action"])
        planned = self._ahead(before, torch.cat((action[:, None].to(left), left[:, :-1]), dim=1))
        self._carried = {"plan": after["plan"]}
        for key in getattr(getattr(self._planner, "imagined", None), "carried_keys", ()):
            self._carried[key] = after["next", key]
        return action[0].double().numpy(), planned[0].double().numpy()

    def reward_of(self, state: Tensor, action: np.ndarray, after: Tensor) -> float:
        """Return the reward of a step between states ``[N, C]``."""
        return step_reward(self.reward, self.target, state, action, after)


def step_reward(reward: Reward, target: Tensor | None, state: Tensor, action: np.ndarray, after: Tensor) -> float:
    """Return the reward of an action ``[A]`` between states ``[N, C]``, for a target if the task has one."""
    task = None if target is None else reward.task_of(state[None], target[None])
    return float(reward(state[None], torch.from_numpy(action)[None], after[None], task))


def _system(scene: Scene) -> str:
    return re.sub(r"^swimmer\d+$", "swimmerN", scene.origin.get("system", ""))
