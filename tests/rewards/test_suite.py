"""Rewards of the control suite's tasks, against the suite itself."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch

from torchrl_gn.data import Simulator
from torchrl_gn.rewards import SUITE_TASKS, Near, Reward, Run, RunUpright, make_reward, suite_reward, tolerance
from torchrl_gn.scenes import load_scene, load_suite_task
from torchrl_gn.scenes.suite_tasks import episode_target, full_physics, has_target

suite = pytest.importorskip("dm_control.suite")


def suite_rewards(loaded, states: np.ndarray) -> np.ndarray:
    """Rewards of the suite's task in full MuJoCo states ``[M, S]``."""
    physics, given = loaded.physics, []
    for state in states:
        mujoco.mj_setState(physics.model.ptr, physics.data.ptr, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_forward(physics.model.ptr, physics.data.ptr)
        given.append(loaded.task.get_reward(physics))
    return np.array(given)


def random_states(scene, low: float, high: float) -> np.ndarray:
    """States ``[200, S]`` at any pose near the start, with velocities of both signs up to past the wanted speed."""
    rng, model = np.random.default_rng(0), scene.model
    states = np.zeros((200, scene.physics_size))
    data = mujoco.MjData(model)
    mujoco.mj_getState(model, data, states[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)
    states[:] = states[0]
    states[:, 1 : 1 + model.nq] += rng.uniform(-1, 1, (200, model.nq))
    states[:, 1 + model.nq : 1 + model.nq + model.nv] = rng.uniform(low, high, (200, model.nv))
    return states


@pytest.mark.parametrize(
    ("system", "domain", "task", "speed"),
    [
        ("cheetah", "cheetah", "run", 10.0),
        ("walker2d", "walker", "run", 8.0),
        ("walker2d", "walker", "walk", 1.0),
        ("walker2d", "walker", "stand", 0.0),
    ],
)
def test_equals_the_suite(system: str, domain: str, task: str, speed: float) -> None:
    scene = load_scene(system)
    states = random_states(scene, -6.0, 16.0)
    observed = Simulator(scene).observe(torch.as_tensor(states))
    kind: type[Reward] = Run if system == "cheetah" else RunUpright
    reward = kind(scene, "torso", speed=speed)
    ours = reward(observed, torch.zeros(200, scene.num_actions), observed).squeeze(-1)
    theirs = suite_rewards(suite.load(domain, task), states)
    assert theirs.std() > 0.02
    np.testing.assert_allclose(ours.numpy(), theirs, atol=1e-9)


def test_near_equals_the_suites_swimmer() -> None:
    scene = load_scene("swimmer6")
    states = random_states(scene, -1.0, 1.0)
    loaded = suite.load("swimmer", "swimmer6")
    loaded.physics.named.model.geom_pos["target", ["x", "y"]] = 0.0
    theirs = suite_rewards(loaded, states)
    observed = Simulator(scene).observe(torch.as_tensor(states)).requires_grad_()
    reward, action = make_reward("near", scene), torch.zeros(200, scene.num_actions)
    ours = reward(observed, action, observed)
    assert theirs.std() > 0.1 and theirs.max() == 1.0
    np.testing.assert_allclose(ours.detach().squeeze(-1).numpy(), theirs, atol=1e-9)
    ours.sum().backward()
    assert observed.grad is not None and bool(observed.grad.isfinite().all())
    # With a target of the episode's own, which may be anywhere.
    moving = Near(scene, "head", offset=(0.0, -0.06, 0.0))
    shift = torch.tensor([3.0, -2.0, 0.0], dtype=torch.float64)
    moved = observed.detach().clone()
    moved[:, 1:, :3] += shift
    target = shift + torch.tensor([0.0, 0.0, 0.05])
    torch.testing.assert_close(moving(moved, action, moved, target.expand(200, 3)), ours.detach())
    with pytest.raises(ValueError, match=r"radius=0 and margin=0\.5"):
        Near(scene, "head", radius=0)


def test_by_name_and_differentiable() -> None:
    scene = load_scene("walker2d")
    state = Simulator(scene).observe(torch.as_tensor(random_states(scene, 0.0, 3.0)[:4])).requires_grad_()
    reward = make_reward("run", scene)
    reward(state, torch.zeros(4, scene.num_actions), state).sum().backward()
    assert state.grad is not None and bool(state.grad.isfinite().all()) and bool((state.grad != 0).any())


def test_refuses_what_does_not_fit() -> None:
    scene = load_scene("cheetah")
    with pytest.raises(ValueError, match="no body 'tail'"):
        Run(scene, "tail")
    with pytest.raises(ValueError, match="speed must be a positive"):
        Run(scene, "torso", speed=0.0)
    with pytest.raises(ValueError, match="from 0"):
        RunUpright(scene, "torso", speed=-1.0)


FAST = ("cheetah/run", "cartpole/swingup", "hopper/hop", "quadruped/run", "humanoid/stand")
# Without a gradient: what they pay for the state is all or nothing.
BINARY = {
    "acrobot/swingup_sparse",
    "ball_in_cup/catch",
    "cartpole/balance_sparse",
    "cartpole/swingup_sparse",
    "finger/spin",
    "finger/turn_easy",
    "finger/turn_hard",
    "reacher/easy",
    "reacher/hard",
    "hopper/stand",
    "pendulum/swingup",
}


@pytest.mark.parametrize(
    "task", [task if task in FAST else pytest.param(task, marks=pytest.mark.slow) for task in SUITE_TASKS]
)
def test_is_what_dm_control_pays(task: str) -> None:
    """Along episodes of random actions whose speeds are set to anything now and then."""
    domain, name = task.split("/")
    scene, env = load_scene(f"suite:{task}"), load_suite_task(domain, name, 0)
    rng, spec, data = np.random.default_rng(0), env.action_spec(), env.physics.data.ptr
    states, actions, targets, paid = [], [], [], []
    speeds = {"fish": [0.0], "swimmer": [0.0, 0.1]}.get(domain, [0.1, 1.0, 20.0])  # which stay stable
    for episode in range(12):
        env.reset()
        if episode < 3:
            env.physics.reset()  # to the pose of the file, where point_mass has its target
        for step in range(12):
            if step % 4 == 0:
                data.qvel[:] = rng.uniform(-1, 1, scene.model.nv) * rng.choice(speeds)
                env.physics.forward()
            action = rng.uniform(spec.minimum, spec.maximum) * rng.choice([0.0, 1.0])
            before = full_physics(env)
            paid.append(env.step(action).reward)
            states.append((before, full_physics(env)))
            actions.append(action)
            targets.append(episode_target(env) if has_target(task) else np.zeros(3))
    before, after = Simulator(scene).observe(torch.from_numpy(np.stack(states))).unbind(1)
    after.requires_grad_()
    reward, goals = suite_reward(scene), torch.from_numpy(np.stack(targets))
    given = reward(before, torch.from_numpy(np.stack(actions)), after, goals if has_target(task) else None)
    assert reward.target_shape == ((3,) if has_target(task) else None)
    np.testing.assert_allclose(given.detach().squeeze(-1).numpy(), paid, atol=1e-9)
    assert has_target(task) or len(np.unique(paid)) > 1 or task in BINARY
    if task not in BINARY:
        assert np.std(paid) > 1e-3
        (gradient,) = torch.autograd.grad(given.sum(), after)
        assert bool(gradient.isfinite().all()) and bool((gradient != 0).any())


def test_by_the_scene_alone() -> None:
    scene = load_scene("suite:pendulum/swingup")
    state = Simulator(scene).observe(torch.as_tensor(scene.rest_physics).unsqueeze(0))
    for reward in (suite_reward(scene), make_reward(None, scene)):
        assert reward(state, torch.zeros(1, 1), state, None).item() == 1.0  # the pole at rest stands
    with pytest.raises(ValueError, match="'cheetah' is not a task of the suite whose reward is known; there are"):
        make_reward(None, load_scene("cheetah"))
    with pytest.raises(ValueError, match="'humanoid_CMU-stand' is not a task"):
        suite_reward(load_scene("suite:humanoid_CMU/stand"))


@pytest.mark.parametrize("sigmoid", ["gaussian", "linear", "long_tail", "quadratic"])
@pytest.mark.parametrize("margin", [0.0, 0.7])
def test_tolerance_is_dm_controls(sigmoid, margin: float) -> None:
    from dm_control.utils import rewards

    x = np.linspace(-3, 3, 61)
    theirs = rewards.tolerance(x, bounds=(-0.5, 1.0), margin=margin, sigmoid=sigmoid, value_at_margin=0.2)
    ours = tolerance(torch.from_numpy(x), -0.5, 1.0, margin=margin, sigmoid=sigmoid, at_margin=0.2)
    np.testing.assert_allclose(ours.numpy(), theirs, atol=1e-12)
    with pytest.raises(ValueError, match="got 'round'"):
        tolerance(torch.zeros(1), margin=1.0, sigmoid="round")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    "wrong",
    [
        {"low": 2.0, "high": 1.0},
        {"margin": -1.0},
        {"margin": math.nan},
        {"margin": 1.0, "at_margin": 1.5},
        {"margin": 1.0, "at_margin": 0.0},
        {"margin": 1.0, "at_margin": -0.1, "sigmoid": "linear"},
    ],
)
def test_tolerances_that_are_none_are_refused(wrong) -> None:
    with pytest.raises(ValueError, match="low=2.0 must be|margin="):
        tolerance(torch.zeros(1), **wrong)
