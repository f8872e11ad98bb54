"""Derivatives of control steps against MuJoCo's own and against differences of higher order."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from torchrl_gn.data import Simulator, sample_start_states, spline_controls
from torchrl_gn.planners.linearize import Tangent, linearize
from torchrl_gn.scenes import Scene, load_scene

from .. import zoo


def trajectory(scene: Scene, steps: int, seed: int = 0) -> tuple[Simulator, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    simulator = Simulator(scene, num_threads=1)
    start = sample_start_states(scene, 1, rng)
    model = scene.model
    start[:, 1 + model.nq : 1 + model.nq + model.nv] = 0.5 * rng.standard_normal(model.nv)
    actions = 0.9 * spline_controls(scene, 1, steps, rng)
    return simulator, simulator.rollout(start, actions)["physics"][0].numpy(), actions[0]


def chained_transitions(scene: Scene, physics: np.ndarray, action: np.ndarray) -> np.ndarray:
    """``mjd_transitionFD`` of each physics step, chained over one control step."""
    model, data = scene.model, mujoco.MjData(scene.model)
    size, num = 2 * model.nv, model.nu
    by_state, by_action = np.eye(size), np.zeros((size, num))
    mujoco.mj_setState(model, data, physics, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    data.ctrl[:] = action
    for _ in range(scene.substeps):
        a, b = np.zeros((size, size)), np.zeros((size, num))
        mujoco.mjd_transitionFD(model, data, 1e-6, True, a, b, None, None)
        by_state, by_action = a @ by_state, a @ by_action + b
        mujoco.mj_step(model, data)
    return np.concatenate([by_state, by_action], axis=1)


@pytest.mark.parametrize("central", [False, True])
def test_equals_mujocos_chained_transitions(central):
    scene = load_scene("swimmer6")
    simulator, physics, actions = trajectory(scene, 3)
    found = linearize(simulator, physics, actions, central=central).dynamics
    wanted = np.stack([chained_transitions(scene, x, u) for x, u in zip(physics, actions, strict=False)])
    np.testing.assert_allclose(found, wanted, atol=(2e-7 if central else 1e-4) * np.abs(wanted).max())


def fourth_order(simulator: Simulator, physics: np.ndarray, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same derivatives, of one step, by differences of the fourth order with a large step."""
    scene = simulator.scene
    tangent, num, h = Tangent(scene), scene.num_actions, 1e-3
    steps, bodies = [], []
    for column in range(tangent.size + num):
        change = np.zeros(tangent.size + num)
        change[column] = h
        ends = []
        for times in (1, -1, 2, -2):
            start = tangent.add(physics, times * change[: tangent.size])
            moved = simulator.rollout(start, (action + times * change[tangent.size :])[None])
            ends.append((moved["physics"][1].numpy(), moved["state"][0].numpy().ravel()))
        (p1, s1), (m1, t1), (p2, s2), (m2, t2) = ends
        steps.append((8 * tangent.subtract(p1, m1) - tangent.subtract(p2, m2)) / (12 * h))
        bodies.append((8 * (s1 - t1) - (s2 - t2)) / (12 * h))
    return np.stack(steps, 1), np.stack(bodies[: tangent.size], 1)


@pytest.mark.parametrize("source", ["tumbler", "cartpole"])
def test_runge_kutta_scenes_equal_higher_order_differences(source):
    scene = zoo.load(source)
    assert scene.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    simulator, physics, actions = trajectory(scene, 2)
    found = linearize(simulator, physics, actions, central=True)
    for t in range(2):
        dynamics, bodies = fourth_order(simulator, physics[t], actions[t])
        np.testing.assert_allclose(found.dynamics[t], dynamics, atol=1e-6 * np.abs(dynamics).max())
        np.testing.assert_allclose(found.bodies[t], bodies, atol=1e-6 * np.abs(bodies).max())


def test_last_state_shows_its_bodies():
    simulator, physics, actions = trajectory(load_scene("acrobot"), 3)
    found = linearize(simulator, physics, actions, central=True)
    _, bodies = fourth_order(simulator, physics[3], actions[2])
    np.testing.assert_allclose(found.bodies[3], bodies, atol=1e-6 * np.abs(bodies).max())


@pytest.mark.parametrize("central", [False, True])
def test_controls_at_bounds_are_perturbed_inwards(central):
    # Outside the bounds MuJoCo clamps them: the derivative there would be halved or zero.
    scene = load_scene("cartpole")
    simulator, physics, actions = trajectory(scene, 3)
    inside = linearize(simulator, physics, actions, central=central).dynamics[..., -1]
    bounds = np.array([scene.action_low, scene.action_high, scene.action_low])
    at_bounds = linearize(simulator, physics, bounds, central=central).dynamics[..., -1]
    np.testing.assert_allclose(at_bounds, inside, rtol=1e-3, atol=1e-6 * np.abs(inside).max())


@pytest.mark.parametrize("central", [False, True])
def test_fixed_controls_change_nothing(central):
    scene = load_scene("swimmer6")
    fixed = np.arange(scene.num_actions) == 1
    low, high = (np.where(fixed, 0.25, bound) for bound in (scene.action_low, scene.action_high))
    simulator, physics, actions = trajectory(replace(scene, action_low=low, action_high=high), 3)
    actions[:, fixed] = 0.25
    found = linearize(simulator, physics, actions, central=central).dynamics[..., -scene.num_actions :]
    assert (found[..., fixed] == 0).all() and (np.abs(found[..., ~fixed]).max(axis=1) > 0).all()


def test_tangent_is_its_own_inverse():
    scene = zoo.load("tumbler")
    tangent = Tangent(scene)
    start = sample_start_states(scene, 4, 0)
    change = 0.3 * np.random.default_rng(0).standard_normal((5, 4, tangent.size))
    np.testing.assert_allclose(tangent.subtract(tangent.add(start, change), start), change, atol=1e-12)


def test_unstable_steps_are_nan():
    scene = load_scene("pendulum")
    simulator, physics, actions = trajectory(scene, 2)
    physics[1, -1] = 1e9
    found = linearize(simulator, physics, actions).dynamics
    assert np.isfinite(found[0]).all()
    physics[1, -1] = 1e10 - 1e-7
    assert np.isnan(linearize(simulator, physics, actions, epsilon=1.0).dynamics[1]).any()
