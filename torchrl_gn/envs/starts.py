"""Start states of episodes, and of batches of environments."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import BatchSizeTransform, EnvBase, TransformedEnv

from torchrl_gn.data.controls import numpy_generator
from torchrl_gn.data.simulate import Simulator
from torchrl_gn.data.start_states import draw_start_states
from torchrl_gn.scenes.kinematic_tree import KinematicTree
from torchrl_gn.scenes.scene import Scene

StartStates = Tensor | np.ndarray | Callable[[int, np.random.Generator], np.ndarray]


class StartSampler:
    """Draw start states of a scene (the first of its variants) or of a robot known by its joints, reproducibly.

    ``start_states`` are ``[M, S]`` full MuJoCo states, drawn uniformly, or a function ``(n, generator) -> [n, S]``;
    by default those of the system. A robot of joints needs node states ``[M, N, C]``. Others raise ValueError.
    """

    def __init__(
        self, scene: Scene | KinematicTree, start_states: StartStates | None = None, seed: int | None = None
    ) -> None:
        self.scene = scene
        joints = isinstance(scene, KinematicTree)
        self.shape = (scene.num_nodes, scene.state_size) if joints else (scene.physics_size,)
        if joints and start_states is None:
            raise ValueError(
                f"Nothing is known of where robot {scene.name!r} starts; give start_states"
                f" [M, {scene.num_nodes}, {scene.state_size}], those of its log, say."
            )
        self._function: Callable[[int, np.random.Generator], np.ndarray] | None = None
        self._table: np.ndarray | None = None
        if isinstance(start_states, (Tensor, np.ndarray)):
            self._table = self._checked(start_states, None)
        else:
            self._function = start_states
        self.seed(seed)

    def seed(self, seed: int | None) -> None:
        """Restart the draws."""
        self._rng = numpy_generator(seed)

    def draw(
        self,
        shape: torch.Size,
        reset: Tensor | None = None,
        variant: Tensor | None = None,
        *,
        simulator: Simulator | None,
    ) -> Tensor:
        """Return start states ``[*B, S]`` (robot of joints: ``[*B, N, C]``), float64, on the CPU, for a batch shape.

        Args:
            reset: ``[*B]`` or ``[*B, 1]`` bool, samples to draw for (default all); the others get a copy of one.
            variant: ``[*B, 1]`` index of each sample's variant, if there are several.
            simulator: of the scene or its variants; None for a robot of joints.
        """
        size = shape.numel()
        mask = np.ones(size, dtype=bool) if reset is None else reset.reshape(size).cpu().numpy()
        states = np.zeros((size, *self.shape))
        count = int(mask.sum())
        if count:
            which = None if variant is None else variant.reshape(size).cpu().numpy()[mask]
            drawn = self._sample(count, which, simulator)
            states[:] = drawn[0]
            states[mask] = drawn
        return torch.from_numpy(states).reshape(*shape, *self.shape)

    def _sample(self, count: int, variant: np.ndarray | None, simulator: Simulator | None) -> np.ndarray:
        if self._table is not None:
            return self._table[self._rng.integers(len(self._table), size=count)]
        if self._function is not None:
            return self._checked(self._function(count, self._rng), count)
        variant = np.zeros(count, dtype=np.int64) if variant is None else variant
        # A robot of joints has one of the above.
        return draw_start_states(cast(Simulator, simulator), variant, self._rng)[0]

    def _checked(self, states: Tensor | np.ndarray, count: int | None) -> np.ndarray:
        if isinstance(states, Tensor):
            states = states.detach().cpu().numpy()
        states = np.array(states, dtype=np.float64)
        right = states.shape[1:] == self.shape and len(states) > 0
        if not right or (count is not None and len(states) != count):
            wanted = f"[{', '.join(map(str, ('M' if count is None else count, *self.shape)))}]"
            raise ValueError(f"start states of {self.scene.name!r} must be {wanted}, got {list(states.shape)}")
        finite = np.isfinite(states).reshape(len(states), -1).all(axis=1)
        if not finite.all():
            bad = int(np.flatnonzero(~finite)[0])
            raise ValueError(f"start state {bad} of {self.scene.name!r} is not finite")
        return states


class _Starts:
    """Reset every sample of a batch to its own start state: ``BatchSizeTransform`` alone repeats one."""

    def __init__(self, env: EnvBase, batch_size: torch.Size) -> None:
        self.env, self.batch_size = env, batch_size

    def __call__(self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase) -> TensorDictBase:
        if tensordict_reset.shape == self.batch_size:
            return tensordict_reset
        return self.env.reset(TensorDict(batch_size=self.batch_size))


def batched(env: EnvBase, *batch_size: int) -> TransformedEnv:
    """Fix the number of environments ``batch_size`` of a stateless one, each with its own start state.

    Example:
        >>> from torchrl_gn.envs import SceneEnv
        >>> from torchrl_gn.scenes import load_scene
        >>> batched(SceneEnv(load_scene("pendulum"), seed=0), 4).rollout(5)["state"].shape
        torch.Size([4, 5, 2, 13])
    """
    size = torch.Size(batch_size)
    if not size or min(size) < 1:
        raise ValueError(f"batch_size must be numbers of at least 1, got {list(size)}")
    return TransformedEnv(env, BatchSizeTransform(batch_size=size, reset_func=_Starts(env, size)))
