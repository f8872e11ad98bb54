"""Random targets of swimmers, in squares around the start."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_gn.data import sample_start_states
from torchrl_gn.envs import observation_env
from torchrl_gn.scenes import ObservationGraph, Scene


class TargetSquares:
    """Random targets in a square around the start. The target stays at the origin; the scene moves instead.

    Args:
        scene: a scene whose root slides along x and y and whose physics do not depend on the place, such as a swimmer.
        half_sides: half sides of the squares, metres; all equally likely.

    Raises:
        ValueError: a half side is not positive, or the scene cannot be moved to any place.

    Example:
        >>> from torchrl_gn.scenes import load_scene
        >>> squares = TargetSquares(load_scene("swimmer6"), [0.3, 2.0])
        >>> squares.start_states(5, np.random.default_rng(0)).shape == (5, squares.scene.physics_size)
        True
    """

    def __init__(self, scene: Scene, half_sides: Sequence[float]) -> None:
        model, self.scene = scene.model, scene
        self.half_sides = np.array([float(side) for side in half_sides])
        self._sizes = torch.from_numpy(self.half_sides)  # on the device of the states
        if not (self.half_sides > 0).all():
            raise ValueError(f"half_sides={list(half_sides)} must be positive half sides of squares, metres.")
        slides = [
            np.flatnonzero((model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE) & (np.abs(model.jnt_axis) == axis).all(1))
            for axis in np.eye(3)[:2]
        ]
        if not (scene.translation_invariant[:2].all() and all(len(joints) for joints in slides)):
            raise ValueError(f"Target squares need a scene that slides freely along x and y, not {scene.name!r}.")
        self.where = [1 + model.jnt_qposadr[joints[0]] for joints in slides]  # in a MuJoCo state, after the time

    def start_states(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw full MuJoCo states ``[n, S]``, for :class:`~torchrl_gn.envs.SceneEnv`."""
        states = sample_start_states(self.scene, n, rng)
        size = rng.choice(self.half_sides, (n, 1))
        states[:, self.where] = rng.uniform(-size, size, (n, 2))
        return states

    def suite_states(self, n: int, seed: int) -> np.ndarray:
        """Draw full MuJoCo states ``[n, S]`` with the suite's own starts and targets, for evaluation.

        Raises:
            ValueError: the scene is not a swimmer of the suite.
        """
        scene, links = self.scene, self.scene.num_nodes - 1
        if scene.name != f"swimmer{links}":
            raise ValueError(f"The suite has starts and targets of swimmers alone, not of {scene.name!r}.")
        env = observation_env(ObservationGraph.swimmer(links), "swimmer", scene.name, num_envs=n, seed=0)
        env.set_seed(seed)
        env.reset()
        states = np.zeros((n, scene.physics_size))
        for state, wrapped_env in zip(states, cast(Any, env).base_env._envs, strict=True):
            physics = wrapped_env._env.physics
            state[1 : 1 + scene.model.nq] = physics.data.qpos
            state[self.where] -= physics.named.model.geom_pos["target", ["x", "y"]]
        return states

    def move(self, state: Tensor) -> Tensor:
        """Move states ``[B, N, 13]`` so that the first body lies at random in a square around the target."""
        device, count = state.device, len(state)
        self._sizes = self._sizes.to(device)
        sizes = self._sizes[torch.randint(len(self._sizes), (count, 1, 1), device=device)]
        position = sizes * (2 * torch.rand(count, 1, 2, dtype=torch.float64, device=device) - 1)
        moved = state.clone()
        moved[:, 1:, :2] += position.to(state) - state[:, 1:2, :2]
        return moved
