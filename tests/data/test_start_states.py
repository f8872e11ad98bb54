"""Start states against the distributions they are drawn from."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
from scipy import stats

from torchrl_gn.data import Simulator, UnstableSimulationError, sample_start_states
from torchrl_gn.data.start_states import draw_start_states
from torchrl_gn.scenes import SYSTEMS, Scene, load_scene

from .. import zoo
from .conftest import repelled_hinge


def _qpos_qvel(scene: Scene, n: int = 2000) -> tuple[np.ndarray, np.ndarray]:
    states = sample_start_states(scene, n, 0)
    assert states.shape == (n, scene.physics_size) and states.dtype == np.float64
    assert (states[:, 0] == 0).all()
    nq, nv = scene.model.nq, scene.model.nv
    return states[:, 1 : 1 + nq], states[:, 1 + nq : 1 + nq + nv]


def _is_uniform(values: np.ndarray, low: float, high: float) -> bool:
    return stats.kstest(values, "uniform", (low, high - low)).pvalue > 1e-3


@pytest.mark.parametrize("name", ["pendulum", "acrobot"])
def test_unlimited_hinges_are_uniform(name: str) -> None:
    qpos, qvel = _qpos_qvel(load_scene(name))
    assert all(_is_uniform(angle, -np.pi, np.pi) for angle in qpos.T) and not qvel.any()


def test_cartpole() -> None:
    qpos, qvel = _qpos_qvel(load_scene("cartpole"))
    assert _is_uniform(qpos[:, 0], -0.1, 0.1) and _is_uniform(qpos[:, 1], -0.034, 0.034)
    assert all(stats.kstest(v / 0.01, "norm").pvalue > 1e-3 for v in qvel.T)


@pytest.mark.parametrize("name", ["swimmer6", "walker2d", "jaco"])
def test_limited_and_rotational_joints(name: str) -> None:
    scene = load_scene(name)
    qpos, qvel = _qpos_qvel(scene)
    assert not qvel.any()
    for joint, values in enumerate(qpos.T):
        if scene.model.jnt_limited[joint]:
            assert _is_uniform(values, *scene.model.jnt_range[joint])
        elif scene.model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
            assert _is_uniform(values, -np.pi, np.pi)
        else:
            assert (values == scene.model.qpos0[joint]).all()


def test_rotations_are_uniform() -> None:
    qpos, _ = _qpos_qvel(dataclasses.replace(zoo.load("limited_joints"), wide_starts=1.0), 4000)
    ball, limited, place, free, slide = np.split(qpos, [4, 8, 11, 15], axis=1)
    np.testing.assert_array_equal(place, np.tile([0.0, 0.0, 7.0], (4000, 1)))
    for quat in (ball, limited, free):
        np.testing.assert_allclose(np.linalg.norm(quat, axis=1), 1.0, atol=1e-12)
    for quat in (ball, free):  # every direction of the 3-sphere alike
        np.testing.assert_allclose(quat[:, 1:].mean(0), 0.0, atol=0.04)
        np.testing.assert_allclose(quat.T @ quat / len(quat), np.eye(4) / 4, atol=0.02)
    angle = 2 * np.arccos(limited[:, 0])
    assert _is_uniform(angle, 0, np.deg2rad(40)) and _is_uniform(slide[:, 0], -2.0, 0.5)


def test_cheetah_settles() -> None:
    scene = load_scene("cheetah")
    drawn = sample_start_states(dataclasses.replace(scene, settle_steps=0), 3, 5)
    states = sample_start_states(scene, 3, 5)
    data, expected = mujoco.MjData(scene.model), np.empty(scene.physics_size)
    for i in range(3):
        mujoco.mj_setState(scene.model, data, drawn[i], mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_step(scene.model, data, 200)
        mujoco.mj_getState(scene.model, data, expected, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        np.testing.assert_array_equal(states[i, 1:], expected[1:])
        assert states[i, 0] == 0 and data.ncon > 0
    joints = slice(4, 1 + scene.model.nq)  # after the time and the root's three
    low, high = scene.model.jnt_range[3:].T
    assert (drawn[:, joints] >= low).all() and (drawn[:, joints] <= high).all()
    assert not drawn[:, 1:4].any()


@pytest.mark.parametrize("name", SYSTEMS)
def test_repeatable_and_different(name: str) -> None:
    scene = load_scene(name)
    first = sample_start_states(scene, 3, 1)
    np.testing.assert_array_equal(first, sample_start_states(scene, 3, np.random.default_rng(1)))
    assert not np.array_equal(first, sample_start_states(scene, 3, 2))
    assert len(np.unique(first, axis=0)) == 3
    assert sample_start_states(scene, 0, 1).shape == (0, scene.physics_size)


def test_unstable_starts_are_drawn_again_and_counted() -> None:
    wide = {"settle_steps": 1, "wide_starts": 1.0}
    scene = dataclasses.replace(repelled_hinge(1.5), **wide)
    states, rejected = draw_start_states(Simulator(scene), np.zeros(200, dtype=int), 0)
    assert (np.abs(states[:, 1]) < 1.501).all() and 150 < rejected < 300
    with pytest.raises(UnstableSimulationError, match="'repelled'.*1 physics steps"):
        sample_start_states(dataclasses.replace(repelled_hinge(0.01), **wide), 50, 0)


def test_the_arm_never_starts_inside_itself():
    scene = load_scene("jaco")
    data = mujoco.MjData(scene.model)
    for state in sample_start_states(scene, 200, 0):
        mujoco.mj_setState(scene.model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_forward(scene.model, data)
        assert not (data.contact.dist < 0).any()
