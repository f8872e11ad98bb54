"""Rewards of the control suite's running tasks, against the suite itself."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from torchrl_gn.data import Simulator
from torchrl_gn.rewards import Reward, Run, RunUpright, make_reward
from torchrl_gn.scenes import load_scene

suite = pytest.importorskip("dm_control.suite")


def suite_rewards(domain: str, task: str, states: np.ndarray) -> np.ndarray:
    """What the suite's task gives in full MuJoCo states ``[M, S]``."""
    loaded = suite.load(domain, task)
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
    theirs = suite_rewards(domain, task, states)
    assert theirs.std() > 0.02
    np.testing.assert_allclose(ours.numpy(), theirs, atol=1e-9)


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
