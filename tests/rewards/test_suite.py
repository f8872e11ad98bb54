"""Rewards of the control suite's running and swimming tasks, against the suite itself."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from torchrl_gn.data import Simulator
from torchrl_gn.rewards import Near, Reward, Run, RunUpright, make_reward
from torchrl_gn.scenes import load_scene

suite = pytest.importorskip("dm_control.suite")


def suite_rewards(loaded, states: np.ndarray) -> np.ndarray:
    """What the suite's task gives in full MuJoCo states ``[M, S]``."""
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
