"""Rewards add and scale, and come from options."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
import torch

from torchrl_gn.rewards import Balance, Distance, Effort, Near, Reach, Velocity, WeightedSum, make_reward
from torchrl_gn.scenes import load_scene


@pytest.fixture(scope="module")
def swimmer(make_steps):
    return make_steps(load_scene("swimmer3"))


def values(reward, moving, task=None):
    return reward(moving.state, moving.action, moving.next_state, task)


def test_rewards_add_and_scale(swimmer):
    forward, effort = Velocity(swimmer.scene, "head", "x"), Effort(swimmer.scene)
    total = forward + 0.5 * effort - forward * 2
    expected = -values(forward, swimmer) + 0.5 * values(effort, swimmer)
    torch.testing.assert_close(values(total, swimmer), expected)
    torch.testing.assert_close(values(-total, swimmer), -expected)
    assert isinstance(total, WeightedSum) and len(total.terms) == 3
    assert repr(total).count("Velocity") == 2
    plain = cast(Any, forward)
    for wrong in (lambda: plain + 1, lambda: plain * "2", lambda: plain - None, lambda: plain + Effort):
        with pytest.raises(TypeError):
            wrong()


def test_functions_add_to_rewards(swimmer):
    def squared(state, action, next_state, task=None):
        return action.square().sum(-1, keepdim=True)

    effort = Effort(swimmer.scene)
    expected = squared(swimmer.state, swimmer.action, swimmer.next_state), values(effort, swimmer)
    torch.testing.assert_close(values(squared + 2 * effort, swimmer), expected[0] + 2 * expected[1])
    torch.testing.assert_close(values(effort - squared, swimmer), expected[1] - expected[0])
    assert "squared" in repr(effort + squared)


def test_one_of_them_may_need_a_target(swimmer):
    reach, effort = Reach(swimmer.scene, "head"), Effort(swimmer.scene)
    total, target = reach + 0.1 * effort, torch.tensor([1.0, 2, 0], dtype=torch.float64).expand(4, 3)
    assert total.target_shape == (3,)
    task = total.task_of(swimmer.state, target)
    assert torch.equal(task, reach.task_of(swimmer.state, target))
    expected = values(reach, swimmer, task) + 0.1 * values(effort, swimmer)
    torch.testing.assert_close(values(total, swimmer, task), expected)
    with pytest.raises(ValueError, match="At most one reward of a sum may need a target"):
        _ = reach + Distance(swimmer.scene, "head")
    with pytest.raises(ValueError, match="needs no target"):
        (effort + effort).task_of(swimmer.state, target)


@pytest.mark.parametrize("power", [1, 2])
def test_distance(swimmer, power):
    target, offset = [0.3, -0.2, 0.1], [0.05, 0.0, 0.0]
    truth = swimmer.truth("head")
    point = truth.position + np.einsum("bij,j->bi", truth.rotation, offset)
    expected = -(np.linalg.norm(point - target, axis=1) ** power)
    reward = Distance(swimmer.scene, "head", target=target, offset=offset, power=power)
    np.testing.assert_allclose(values(reward, swimmer)[:, 0], expected, atol=1e-12)
    given = Distance(swimmer.scene, "head", offset=offset, power=power)
    task = given.task_of(swimmer.state, torch.tensor(target, dtype=torch.float64).expand(4, 3))
    assert torch.equal(values(given, swimmer, task), values(reward, swimmer))
    state = swimmer.next_state.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda one: reward(one, swimmer.action, one), [state])
    there = state[:1, 1, :3].detach()
    at_target = Distance(swimmer.scene, "head", target=there[0].tolist(), power=power)
    (gradient,) = torch.autograd.grad(at_target(state[:1], swimmer.action[:1], state[:1]).sum(), state)
    assert gradient.isfinite().all() and gradient[0, 1, :3].abs().max() < 1e-12


@pytest.mark.parametrize("power", [1, 2])
def test_distance_from_another_body(swimmer, power):
    scene, state, options = swimmer.scene, swimmer.next_state, {"offset": [0.05, 0.0, 0.0], "power": power}
    other = scene.node_names[-1]
    reward = make_reward([{"type": "Distance", "body": "head", "target": other, **options}], scene)
    for row, place in enumerate(swimmer.truth(other).position):
        fixed = Distance(scene, "head", target=place, **options)
        torch.testing.assert_close(values(reward, swimmer)[row], values(fixed, swimmer)[row], rtol=0, atol=1e-12)
    state = state.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda one: reward(one, swimmer.action, one), [state])
    near = Near(scene, "head", target=other, radius=0.01)
    assert near.target_shape is None and bool((values(near, swimmer) < 1).all())
    with pytest.raises(ValueError, match="bodies must be distinct"):
        Distance(scene, "head", target="head")
    with pytest.raises(ValueError, match="has no body 'cube'"):
        Distance(scene, "head", target="cube")


def test_effort_is_relative_to_the_bounds(swimmer):
    reward, scene = Effort(swimmer.scene), swimmer.scene
    full = torch.from_numpy(scene.action_high).expand(4, -1)
    assert torch.equal(reward(swimmer.state, full, swimmer.next_state), -torch.ones(4, 1, dtype=torch.float64))
    assert (reward(swimmer.state, 0 * full, swimmer.next_state) == 0).all()


def test_a_sum_from_options(swimmer):
    options = [
        {"type": "Velocity", "body": "head", "axis": "x"},
        {"type": "Balance", "weight": 0.2, "bodies": ["head"]},
    ]
    found = make_reward(options, swimmer.scene)
    expected = Velocity(swimmer.scene, "head", "x") + 0.2 * Balance(swimmer.scene, ["head"])
    assert torch.equal(values(found, swimmer), values(expected, swimmer))


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"type": "Fly"}, "Reward type 'Fly' is not known; use one of .*'Velocity'"),
        ({"body": "head"}, "Reward type None is not known"),
        ({"type": "Velocity", "bodies": ["head"], "axis": "x"}, r"Velocity takes no \['bodies'\]; it takes \['body'"),
        ({"type": "Velocity", "body": "head"}, r"Velocity needs \['axis'\]; it takes \['body', 'axis'"),
        ({"type": "Velocity", "body": "tail", "axis": "x"}, "has no body 'tail'"),
        ({"type": "Distance", "body": "head", "target": [1, 2]}, "target must be three finite numbers"),
        ({"type": "Distance", "body": "head", "power": 3}, "power must be 1 or 2"),
    ],
)
def test_bad_options_are_named(swimmer, option, message):
    with pytest.raises(ValueError, match=message):
        make_reward([option], swimmer.scene)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"type": "Effort"}, "must be a list of terms, .*; got one term, {'type': 'Effort'}"),
        (3, "must be a list of terms, .*; got 3"),
        (["Effort"], "A term of a reward must be a dictionary, .*; got 'Effort'"),
    ],
)
def test_options_that_are_no_list_of_terms_are_refused(swimmer, options, message):
    with pytest.raises(TypeError, match=message):
        make_reward(options, swimmer.scene)
