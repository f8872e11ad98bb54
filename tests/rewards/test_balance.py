"""The balance reward against the angle it stands for."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torchrl_gn.rewards import Balance, available_rewards, find_body, make_reward
from torchrl_gn.scenes import load_scene

from .. import zoo


@pytest.fixture(scope="module")
def pendulum():
    return load_scene("pendulum")


def rotated_about_y(scene, angle: torch.Tensor, name: str = "pole") -> torch.Tensor:
    """States ``[*B, N, 13]`` whose body is turned by ``angle`` ``[*B]`` about y."""
    node = scene.node_names.index(name)
    quaternions = torch.zeros(*angle.shape, scene.num_nodes, 4, dtype=angle.dtype)
    quaternions[..., 0] = 1
    zero = torch.zeros_like(angle)
    turned = torch.stack(((angle / 2).cos(), zero, (angle / 2).sin(), zero), -1)
    rows = [turned if i == node else quaternions[..., i, :] for i in range(scene.num_nodes)]
    rest = torch.zeros(*angle.shape, scene.num_nodes, 6, dtype=angle.dtype)
    return torch.cat((rest[..., :3], torch.stack(rows, -2), rest), -1)


def wrapped(angle: torch.Tensor) -> torch.Tensor:
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def test_is_the_negative_wrapped_angle(pendulum):
    reward = make_reward("balance", pendulum)
    angle = torch.linspace(-9, 9, 181, dtype=torch.float64)
    state = rotated_about_y(pendulum, angle)
    got = reward(state, torch.zeros(181, 1), state)
    torch.testing.assert_close(got, -wrapped(angle).abs().unsqueeze(-1), rtol=1e-12, atol=1e-12)


def test_is_zero_at_the_top_and_minus_pi_at_the_bottom(pendulum):
    reward = make_reward("balance", pendulum)
    state = rotated_about_y(pendulum, torch.tensor([0.0, math.pi], dtype=torch.float64))
    top, bottom = reward(state, torch.zeros(2, 1), state).flatten().tolist()
    assert top == 0
    assert bottom == pytest.approx(-math.pi, abs=1e-12)


def test_does_not_see_the_sign_of_a_quaternion(pendulum):
    reward = make_reward("balance", pendulum)
    state = rotated_about_y(pendulum, torch.linspace(-3, 3, 20, dtype=torch.float64))
    flipped = state.clone()
    flipped[..., 3:7] *= -1
    assert torch.equal(reward(None, None, state), reward(None, None, flipped))


@pytest.mark.parametrize(("dtype", "small"), [(torch.float64, 1e-9), (torch.float32, 1e-5)])
def test_keeps_the_digits_of_tiny_angles(pendulum, dtype, small):
    reward = make_reward("balance", pendulum)
    state = rotated_about_y(pendulum, torch.tensor([small], dtype=dtype))
    got = reward(None, None, state)
    assert got.dtype == dtype
    assert got.item() == pytest.approx(-small, rel=1e-6)


def test_gradient_is_the_finite_difference(pendulum):
    reward = make_reward("balance", pendulum)
    angle = torch.tensor([-3.0, -1.2, -1e-3, 0.4, 2.9], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a: reward(None, None, rotated_about_y(pendulum, a)), (angle,))


def test_gradient_is_finite_at_both_ends(pendulum):
    reward = make_reward("balance", pendulum)
    state = rotated_about_y(pendulum, torch.tensor([0.0, math.pi], dtype=torch.float64)).requires_grad_()
    reward(None, None, state).sum().backward()
    assert state.grad.isfinite().all()
    assert (state.grad[0] == 0).all()


def test_takes_any_batch(pendulum):
    reward = make_reward("balance", pendulum)
    state = rotated_about_y(pendulum, torch.rand(2, 3, 4, dtype=torch.float64))
    whole = reward(None, None, state)
    assert whole.shape == (2, 3, 4, 1)
    torch.testing.assert_close(whole[1, 2, 3], reward(None, None, state[1, 2, 3]), rtol=1e-15, atol=0)


def test_sums_over_bodies_and_follows_welded_ones():
    scene = zoo.load("two_links")
    angle = torch.tensor([0.3, -0.5], dtype=torch.float64)
    state = rotated_about_y(scene, angle, "first")
    first = Balance(scene, ["first"])(None, None, state)
    both = Balance(scene, ["first", "second"])(None, None, state)
    torch.testing.assert_close(both, first)  # the second node's own orientation is upright
    flag = Balance(scene, ["flag"])(None, None, state)
    torch.testing.assert_close(flag.flatten(), -(angle + math.pi / 2).abs())
    assert find_body(scene, "flag").node == find_body(scene, "first").node


def test_measures_from_a_given_target(pendulum):
    half = math.pi / 4
    reward = Balance(pendulum, ["pole"], target=np.array([3 * math.cos(half), 0, 3 * math.sin(half), 0]))
    state = rotated_about_y(pendulum, torch.tensor([math.pi / 2, 0.0], dtype=torch.float64))
    torch.testing.assert_close(reward(None, None, state).flatten().tolist(), [0.0, -math.pi / 2])


def test_refuses_what_the_scene_has_not(pendulum):
    with pytest.raises(ValueError, match="'pendulum' has no body 'pool'; it has: world, pole"):
        Balance(pendulum, ["pool"])
    with pytest.raises(ValueError, match="list of body names"):
        Balance(pendulum, "pole")
    with pytest.raises(ValueError, match="target must be"):
        Balance(pendulum, ["pole"], target=torch.ones(3))
    with pytest.raises(ValueError, match="non-zero norm"):
        Balance(pendulum, ["pole"], target=torch.zeros(4))


def test_unknown_tasks_are_listed(pendulum):
    with pytest.raises(ValueError, match=r"no reward 'fly' for scene 'pendulum'; there are: balance \(pendulum\)"):
        make_reward("fly", pendulum)
    assert ("pendulum", "balance") in available_rewards()
    assert isinstance(make_reward("balance", "pendulum"), Balance)  # by the scene's name
