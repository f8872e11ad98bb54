"""A task of the control suite, played by dm_control and observed by the states of its scene."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_gn.checks import check_count
from torchrl_gn.data.controls import known_seed
from torchrl_gn.data.simulate import Simulator
from torchrl_gn.envs.specs import read
from torchrl_gn.finite import require_finite
from torchrl_gn.scenes.scene import Scene
from torchrl_gn.scenes.suite_tasks import episode_target, full_physics, has_target, load_suite_task, suite_modules


class SuiteTaskEnv(EnvBase):
    """Environment of a control suite task, with dm_control's starts, steps, rewards and time limit.

    One control step of the scene is :attr:`action_repeat` control steps of the suite (frames) under the same action;
    its reward is the sum of the frames' rewards. An episode has :attr:`steps` whole control steps.

    Entries:
        - ``state`` ``[M, N, 13]`` float64: as in :class:`~torchrl_gn.envs.SceneEnv`.
        - ``target`` ``[M, 3]`` float64, for tasks whose episodes have a target: its position, metres, world frame.
        - ``action`` ``[M, A]`` float32.
        - ``frames`` ``[M, k, N, 13]`` float64 and ``frame_rewards`` ``[M, k, 1]`` float32, with ``frames=True``: the
          states and the rewards after each of the step's ``k`` frames. If an episode ends within the step, its last
          state is repeated with reward 0.
        - ``done``, ``truncated``, ``terminated`` ``[M, 1]``: the time limit truncates an episode. An episode terminates
          if the task ends it, or if the simulation becomes unstable; the state is then the last good one.

    Args:
        scene: scene from :func:`~torchrl_gn.scenes.load_scene`, for example
            ``load_scene("suite:cheetah/run", timestep=0.02)`` for two frames a step.
        num_envs: number ``M`` of episodes, stepped in turn in this process.
        frames: also observe the frames of a step, for example to train a model of single frames.
        seed: seed of the episodes. Default: drawn from torch's global generator.

    Raises:
        ValueError: the scene is not a task of the suite, or its control step is not a multiple of the suite's.

    Example:
        >>> from torchrl_gn.scenes import load_scene
        >>> env = SuiteTaskEnv(load_scene("suite:cheetah/run", timestep=0.02), num_envs=2)
        >>> env.action_repeat, env.rollout(5)["next", "reward"].shape
        (2, torch.Size([2, 5, 1]))
    """

    def __init__(self, scene: Scene, *, num_envs: int = 1, frames: bool = False, seed: int | None = None) -> None:
        check_count("num_envs", num_envs, 1)
        if "suite" not in scene.origin:
            raise ValueError(f"Scene {scene.name!r} is not a task of the suite; use load_scene('suite:cheetah/run').")
        domain, task = scene.origin["suite"].split("/")
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([num_envs]))
        self.scene, self._simulator = scene, None
        self.episodes = [load_suite_task(domain, task, 0) for _ in range(num_envs)]
        self.action_repeat = _frames_of(scene, self.episodes[0].control_timestep())
        self.steps = int(self.episodes[0]._step_limit) // self.action_repeat
        self._error = suite_modules()[2].PhysicsError
        self.frames, repeat = frames, self.action_repeat
        self._physics = np.zeros((num_envs, repeat, scene.physics_size))  # after each frame of the latest step
        self._targets = np.zeros((num_envs, 3)) if has_target(scene.origin["suite"]) else None
        # Flags of the latest step; at first all episodes are over.
        self._ended = {name: torch.full((num_envs, 1), name == "truncated") for name in ("truncated", "terminated")}
        count = self.batch_size
        shape = torch.Size([*count, scene.num_nodes, scene.state_size])
        seen = {"state": Unbounded(shape=shape, dtype=torch.float64)}
        if self._targets is not None:
            seen["target"] = Unbounded(shape=torch.Size([*count, 3]), dtype=torch.float64)
        if frames:
            each = torch.Size([*count, repeat, scene.num_nodes, scene.state_size])
            seen["frames"] = Unbounded(shape=each, dtype=torch.float64)
            seen["frame_rewards"] = Unbounded(shape=torch.Size([*count, repeat, 1]), dtype=torch.float32)
        self.observation_spec = Composite(seen, shape=count)
        low, high = (
            torch.as_tensor(bound).float().expand(num_envs, -1) for bound in (scene.action_low, scene.action_high)
        )
        self.action_spec = Bounded(low=low, high=high, shape=low.shape, dtype=torch.float32)
        self.reward_spec = Unbounded(shape=torch.Size([*count, 1]), dtype=torch.float32)
        flag = Categorical(2, shape=torch.Size([*count, 1]), dtype=torch.bool)
        flags = {name: flag.clone() for name in ("done", "truncated", "terminated")}
        self.full_done_spec = Composite(flags, shape=count)
        self.set_seed(known_seed(seed))

    @property
    def simulator(self) -> Simulator:
        """The simulator that observes the states."""
        self._simulator = self._simulator or Simulator(self.scene)
        return self._simulator

    @property
    def _over(self) -> Tensor:
        """Episodes ``[M, 1]`` to reset before their next step."""
        return self._ended["truncated"] | self._ended["terminated"]

    def _set_seed(self, seed: int | None) -> None:
        for env, env_seed in zip(
            self.episodes, np.random.SeedSequence(seed).generate_state(len(self.episodes)), strict=True
        ):
            env.task.random.seed(int(env_seed))

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDict:
        which = None if tensordict is None else tensordict.get("_reset", None)
        begins = [True] * len(self.episodes) if which is None else which.reshape(-1).tolist()
        for index, (env, begin) in enumerate(zip(self.episodes, begins, strict=True)):
            if begin:
                env.reset()
                for flag in self._ended.values():
                    flag[index] = False
                self._physics[index] = full_physics(env)
                if self._targets is not None:
                    self._targets[index] = episode_target(env)
        return TensorDict(self._seen(np.zeros((*self.batch_size, self.action_repeat))), self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        # dm_control would broadcast an action of another shape.
        action = read(tensordict, "action", (self.scene.num_actions,), self)
        require_finite(action, f"{self}: 'action'")
        partial = tensordict.get("_step", None)  # TorchRL's mask of the episodes to step
        over = self._over
        steps = torch.ones_like(over) if partial is None else partial.reshape(over.shape)
        if bool((over := over & steps).any()):
            raise RuntimeError(f"{self}: episode {int(over.int().argmax())} has ended; reset it before a step.")
        rewards = np.zeros((len(self.episodes), self.action_repeat))
        ended = {name: flags.clone() for name, flags in self._ended.items()}
        for index, (env, control) in enumerate(zip(self.episodes, action.double().numpy(), strict=True)):
            if not steps[index]:
                self._physics[index] = self._physics[index, -1]
                continue
            discount = self._play(env, control, self._physics[index], rewards[index])
            if discount is not None:
                ended["terminated" if discount == 0 else "truncated"][index] = True
        reward = torch.from_numpy(rewards.sum(1, keepdims=True)).float()
        self._ended = ended
        flags = {name: flags.clone() for name, flags in {**ended, "done": self._over}.items()}
        return TensorDict({**self._seen(rewards), "reward": reward, **flags}, self.batch_size, device=self.device)

    def _play(self, env: Any, control: np.ndarray, physics: np.ndarray, rewards: np.ndarray) -> float | None:
        """Play a control step, writing its frames' states and rewards; return the discount if the episode has ended."""
        physics[0] = physics[-1]
        for frame in range(len(rewards)):
            try:
                step = env.step(control)
            except self._error:
                physics[frame:] = physics[max(frame - 1, 0)]
                return 0.0
            physics[frame:], rewards[frame] = full_physics(env), step.reward
            if step.last():
                return step.discount
        return None

    def _seen(self, rewards: np.ndarray) -> dict[str, Tensor]:
        """Return the observation after a step, with the rewards of its frames."""
        states = self.simulator.observe(torch.from_numpy(self._physics[:, 0 if self.frames else -1 :].copy()))
        seen = {"state": states[:, -1]}
        if self._targets is not None:
            seen["target"] = torch.from_numpy(self._targets.copy())
        return (
            {**seen, "frames": states, "frame_rewards": torch.from_numpy(rewards).float().unsqueeze(-1)}
            if self.frames
            else seen
        )

    def __getstate__(self) -> dict:
        # Copies and worker processes start their own threads and MuJoCo data.
        return {**super().__getstate__(), "_simulator": None}

    def __repr__(self) -> str:
        return f"SuiteTaskEnv({self.scene.name!r}, num_envs={len(self.episodes)})"


def _frames_of(scene: Scene, suite_step: float) -> int:
    """Return the number of suite control steps in one of the scene; ValueError if it is not whole."""
    frames = round(scene.timestep / suite_step)
    if frames < 1 or abs(frames * suite_step - scene.timestep) > 1e-9:
        raise ValueError(
            f"Scene {scene.name!r} has a control step of {scene.timestep:g} s, no multiple of the suite's,"
            f" {suite_step:g} s: load_scene(..., timestep={max(frames, 1) * suite_step:g})."
        )
    return frames
