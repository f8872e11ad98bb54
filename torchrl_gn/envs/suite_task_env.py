"""A task of the control suite as dm_control plays it, seen by the states of its scene."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_gn.data.simulate import Simulator
from torchrl_gn.finite import require_finite
from torchrl_gn.scenes.scene import Scene
from torchrl_gn.scenes.suite_tasks import episode_target, full_physics, has_target, load_suite_task, suite_modules


class SuiteTaskEnv(EnvBase):
    """Episodes of a task of the control suite: dm_control's starts, steps, rewards and time limit.

    One control step of the scene is :attr:`action_repeat` of the suite, its frames, under the same action; the reward
    is the sum of what they pay.

    Entries:
        - ``state`` ``[M, N, 13]`` float64: as of :class:`~torchrl_gn.envs.SceneEnv`.
        - ``target`` ``[M, 3]`` float64, of tasks whose episodes have one: its place, metres, world frame.
        - ``action`` ``[M, A]`` float32.
        - ``done``, ``truncated``, ``terminated`` ``[M, 1]``: at the time limit, an episode is truncated; it is
          terminated where the task ends it, or the simulation becomes unstable, with the last good state kept.

    Args:
        scene: of :func:`~torchrl_gn.scenes.load_scene`, for example ``load_scene("suite:cheetah/run", timestep=0.02)``
            for two frames a step.
        num_envs: ``M`` episodes, stepped in turn in this process.

    Raises:
        ValueError: the scene is no task of the suite, or its control step is not a multiple of the suite's.

    Example:
        >>> from torchrl_gn.scenes import load_scene
        >>> env = SuiteTaskEnv(load_scene("suite:cheetah/run", timestep=0.02), num_envs=2)
        >>> env.action_repeat, env.rollout(5)["next", "reward"].shape
        (2, torch.Size([2, 5, 1]))
    """

    def __init__(self, scene: Scene, *, num_envs: int = 1, seed: int = 0) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs={num_envs} must be at least 1.")
        if "suite" not in scene.origin:
            raise ValueError(f"Scene {scene.name!r} is no task of the suite; load_scene('suite:cheetah/run') is one.")
        domain, task = scene.origin["suite"].split("/")
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([num_envs]))
        self.scene, self.simulator = scene, Simulator(scene)
        self.episodes = [load_suite_task(domain, task, 0) for _ in range(num_envs)]
        self.action_repeat = _frames_of(scene, self.episodes[0].control_timestep())
        self._error = suite_modules()[2].PhysicsError
        self._physics = np.zeros((num_envs, scene.physics_size))
        self._targets = np.zeros((num_envs, 3)) if has_target(scene.origin["suite"]) else None
        self._over = torch.ones(num_envs, 1, dtype=torch.bool)  # which must be reset before they go on
        count = self.batch_size
        shape = torch.Size([*count, scene.num_nodes, scene.state_size])
        seen = {"state": Unbounded(shape=shape, dtype=torch.float64)}
        if self._targets is not None:
            seen["target"] = Unbounded(shape=torch.Size([*count, 3]), dtype=torch.float64)
        self.observation_spec = Composite(seen, shape=count)
        low, high = (torch.as_tensor(of).float().expand(num_envs, -1) for of in (scene.action_low, scene.action_high))
        self.action_spec = Bounded(low=low, high=high, shape=low.shape, dtype=torch.float32)
        self.reward_spec = Unbounded(shape=torch.Size([*count, 1]), dtype=torch.float32)
        flag = Categorical(2, shape=torch.Size([*count, 1]), dtype=torch.bool)
        flags = {name: flag.clone() for name in ("done", "truncated", "terminated")}
        self.full_done_spec = Composite(flags, shape=count)
        self.set_seed(seed)

    def _set_seed(self, seed: int | None) -> None:
        for env, own in zip(
            self.episodes, np.random.SeedSequence(seed).generate_state(len(self.episodes)), strict=True
        ):
            env.task.random.seed(int(own))

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDict:
        which = None if tensordict is None else tensordict.get("_reset", None)
        begins = [True] * len(self.episodes) if which is None else which.reshape(-1).tolist()
        for index, (env, begin) in enumerate(zip(self.episodes, begins, strict=True)):
            if begin:
                env.reset()
                self._over[index] = False
                self._physics[index] = full_physics(env)
                if self._targets is not None:
                    self._targets[index] = episode_target(env)
        return TensorDict(self._seen(), self.batch_size, device=self.device)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action = cast(Tensor, tensordict["action"])
        require_finite(action, f"{self}: 'action'")
        if bool(self._over.any()):
            raise RuntimeError(f"{self}: episode {int(self._over.int().argmax())} has ended; reset it before a step.")
        paid = np.zeros((len(self.episodes), 1))
        ended = {name: torch.zeros(*self.batch_size, 1, dtype=torch.bool) for name in ("truncated", "terminated")}
        for index, (env, control) in enumerate(zip(self.episodes, action.double().numpy(), strict=True)):
            try:
                paid[index], discount = self._frames(env, control)
                self._physics[index] = full_physics(env)
            except self._error:
                discount = 0.0
            if discount is not None:
                ended["terminated" if discount == 0 else "truncated"][index] = True
        entries = {**self._seen(), "reward": torch.from_numpy(paid).float(), **ended}
        self._over = ended["truncated"] | ended["terminated"]
        entries["done"] = self._over.clone()
        return TensorDict(entries, self.batch_size, device=self.device)

    def _frames(self, env: Any, control: np.ndarray) -> tuple[float, float | None]:
        """What the frames of a control step pay, and the discount if the episode has ended."""
        paid = 0.0
        for _ in range(self.action_repeat):
            step = env.step(control)
            paid += step.reward
            if step.last():
                return paid, step.discount
        return paid, None

    def _seen(self) -> dict[str, Tensor]:
        seen = {"state": self.simulator.observe(torch.from_numpy(self._physics.copy()))}
        return seen if self._targets is None else {**seen, "target": torch.from_numpy(self._targets.copy())}

    def __repr__(self) -> str:
        return f"SuiteTaskEnv({self.scene.name!r}, num_envs={len(self.episodes)})"


def _frames_of(scene: Scene, suite_step: float) -> int:
    """The suite's control steps in one of the scene; ValueError if they do not fill it."""
    frames = round(scene.timestep / suite_step)
    if frames < 1 or abs(frames * suite_step - scene.timestep) > 1e-9:
        raise ValueError(
            f"Scene {scene.name!r} has a control step of {scene.timestep:g} s, no multiple of the suite's,"
            f" {suite_step:g} s: load_scene(..., timestep={max(frames, 1) * suite_step:g})."
        )
    return frames
