"""Simulated steps of the paper's systems, with MuJoCo's own numbers beside the states."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import mujoco
import numpy as np
import pytest
import torch

from torchrl_gn.data import Simulator, sample_start_states, spline_controls
from torchrl_gn.scenes import Scene, load_scene


class BodyTruth(NamedTuple):
    """MuJoCo's numbers of one body, in every sample: ``[M, 3]``, rotation ``[M, 3, 3]``."""

    position: np.ndarray
    rotation: np.ndarray
    linear: np.ndarray
    angular: np.ndarray


class Steps:
    """``M`` control steps of a scene from states in the midst of motion."""

    def __init__(self, scene: Scene, count: int = 4, length: int = 30):
        rng = np.random.default_rng(3)
        physics = sample_start_states(scene, count, rng)
        actions = spline_controls(scene, count, length, rng)
        executed = Simulator(scene, num_threads=1).rollout(physics, actions)
        assert executed["stable"].all()
        self.scene, self.physics = scene, executed["physics"]
        self.path = executed["state"]  # [M, T + 1, N, 13]
        self.actions = torch.as_tensor(actions)
        self.action = self.actions[:, -1]
        self.state, self.next_state = self.path[:, -2], self.path[:, -1]

    def truth(self, body: str, step: int = -1) -> BodyTruth:
        """A body after a step, by its name in the model."""
        model, rows = self.scene.model, []
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body)
        assert index >= 0
        for physics in self.physics[:, step].numpy():
            data = mujoco.MjData(model)
            mujoco.mj_setState(model, data, physics, mujoco.mjtState.mjSTATE_FULLPHYSICS)
            mujoco.mj_forward(model, data)
            motion = np.empty(6)
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, index, motion, 0)
            rows.append((data.xpos[index].copy(), data.xmat[index].reshape(3, 3).copy(), motion[3:], motion[:3]))
        return BodyTruth(*(np.stack(column) for column in zip(*rows, strict=True)))


@cache
def _steps(system: str) -> Steps:
    return Steps(load_scene(system))


@pytest.fixture(scope="session")
def steps() -> Callable[[str], Steps]:
    """Steps of a system by its name, simulated once."""
    return _steps


@pytest.fixture(scope="session")
def make_steps() -> type[Steps]:
    """Steps of any scene."""
    return Steps
