"""Start states of episodes, and of batches of environments."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import cast

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import BatchSizeTransform, EnvBase, TransformedEnv

from torchrl_gn.checks import check_count
from torchrl_gn.data.controls import numpy_generator, worker
from torchrl_gn.data.simulate import Simulator
from torchrl_gn.data.start_states import draw_start_states
from torchrl_gn.scenes.articulation import Articulation
from torchrl_gn.scenes.kinematic_tree import KinematicTree

StartStates = Tensor | np.ndarray | Callable[[int, np.random.Generator], np.ndarray]


class StartSampler:
    """Sampler of start states of a scene or kinematic tree; ``start_states`` as in the environments."""

    def __init__(self, scene: Articulation, start_states: StartStates | None = None, seed: int | None = None) -> None:
        self.scene = scene
        joints = isinstance(scene, KinematicTree)
        self.shape = (scene.num_nodes, scene.state_size) if joints else (scene.physics_size,)
        if joints and start_states is None:
            raise ValueError(
                f"Robot {scene.name!r} has no start states of its own; give start_states"
                f" [M, {scene.num_nodes}, {scene.state_size}], for example from its log."
            )
        is_array = isinstance(start_states, (Tensor, np.ndarray))
        self._source = self._checked(start_states, None) if is_array else start_states
        self.seed(seed)

    def seed(self, seed: int | None) -> None:
        """Reseed the draws."""
        self._rng = numpy_generator(seed)
        self._process = worker() if seed is None else None

    def draw(
        self,
        shape: torch.Size,
        reset: Tensor | None = None,
        variant: Tensor | None = None,
        *,
        simulator: Simulator | None,
    ) -> Tensor:
        """Draw start states ``[*B, S]`` (kinematic tree: ``[*B, N, C]``), float64, on the CPU, for a batch shape.

        Samples where ``reset`` ``[*B]`` or ``[*B, 1]`` is False get a copy of another sample's state. ``variant`` is
        ``[*B, 1]``.
        """
        self._differ_in_workers()
        size = shape.numel()
        mask = np.ones(size, dtype=bool) if reset is None else reset.reshape(size).cpu().numpy()
        states = np.zeros((size, *self.shape))
        if count := int(mask.sum()):
            which = None if variant is None else variant.reshape(size).cpu().numpy()[mask]
            drawn = self._sample(count, which, simulator)
            states[:] = drawn[0]
            states[mask] = drawn
        return torch.from_numpy(states).reshape(*shape, *self.shape)

    def draw_variants(self, size: int, count: int) -> Tensor:
        """Return indices ``[size]`` int64 of ``count`` variants: in turn, or at random if the batch has not all."""
        if size >= count:
            return torch.arange(size, device="cpu") % count
        self._differ_in_workers()
        return torch.from_numpy(self._rng.permutation(count)[:size])

    def _differ_in_workers(self) -> None:
        """Reseed a copy for another process, as for the workers of a collector: without a seed, all differ."""
        if self._process is not None and self._process != worker():
            self._process = worker()
            self._rng = np.random.default_rng([*self._rng.integers(2**31, size=2).tolist(), *self._process])

    def _sample(self, count: int, variant: np.ndarray | None, simulator: Simulator | None) -> np.ndarray:
        if isinstance(self._source, np.ndarray):
            return self._source[self._rng.integers(len(self._source), size=count)]
        if self._source is not None:
            return self._checked(self._source(count, self._rng), count)
        variant = np.zeros(count, dtype=np.int64) if variant is None else variant
        # A kinematic tree has returned above.
        return draw_start_states(cast(Simulator, simulator), variant, self._rng)[0]

    def _checked(self, states: Tensor | np.ndarray, count: int | None) -> np.ndarray:
        states = np.array(states.detach().cpu().numpy() if isinstance(states, Tensor) else states, dtype=np.float64)
        if states.shape != (count or max(1, len(states)), *self.shape):
            expected = f"[{', '.join(map(str, (count or 'M', *self.shape)))}]"
            raise ValueError(f"start states of {self.scene.name!r} must be {expected}, got {list(states.shape)}")
        finite = np.isfinite(states).reshape(len(states), -1).all(axis=1)
        if not finite.all():
            raise ValueError(f"start state {int(finite.argmin())} of {self.scene.name!r} is not finite")
        return states


class _Batch(BatchSizeTransform):
    """Batch transform that resets every sample to its own start state; TorchRL's transform repeats one state."""

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        tensordict = super()._reset_env_preprocess(tensordict)  # pyright: ignore[reportArgumentType]
        return TensorDict(batch_size=self.batch_size) if tensordict is None else tensordict


class _Pool(TransformedEnv):
    rand_action = EnvBase.rand_action  # TorchRL takes another for the environment's own, which no transform may change

    @property
    def batch_locked(self) -> bool:
        return True  # it steps only this batch size, also if some episodes have ended


def for_learning(env: EnvBase) -> EnvBase:
    """Return a copy of the environment with the unstable reward for learners; the original is for planners."""
    if not vars(env).get("spares_learners", False):
        return env
    env = copy.copy(env)
    env.unstable_reward = None  # pyright: ignore[reportAttributeAccessIssue]
    return env


def batched(env: EnvBase, *batch_size: int) -> TransformedEnv:
    """Batch a stateless environment to a fixed ``batch_size``, each sample with its own start state.

    The batch is for learning: an unstable step gets the default reward for learning, see
    :class:`~torchrl_gn.envs.SceneEnv`.

    Example:
        >>> from torchrl_gn.envs import SceneEnv
        >>> from torchrl_gn.scenes import load_scene
        >>> batched(SceneEnv(load_scene("pendulum"), seed=0), 4).rollout(5)["state"].shape
        torch.Size([4, 5, 2, 13])
    """
    if not batch_size:
        raise ValueError("batch_size must be numbers of at least 1, got none")
    for size in batch_size:
        check_count("batch_size", size, 1)
    return _Pool(for_learning(env), _Batch(batch_size=torch.Size(batch_size)))
