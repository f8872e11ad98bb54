"""A rollout equals a loop of predictions, with gradients, and refuses wrong shapes."""

from __future__ import annotations

import pytest
import torch

from torchrl_gn.evaluation import rollout

from .conftest import as_model, random_states


def test_rollout_feeds_predictions_back(scenes):
    scene = scenes["swimmer6"]
    model = as_model(lambda state, action: 0.5 * state + action.sum(-1)[..., None, None], scene)
    state = random_states(scene, 2, 3)
    actions = torch.randn(2, 3, 4, scene.num_actions, dtype=torch.float64)
    states = rollout(model, state, actions)
    assert states.shape == (2, 3, 5, scene.num_nodes, 13)
    expected = state
    for step in range(4):
        torch.testing.assert_close(states[:, :, step], expected)
        expected = 0.5 * expected + actions[:, :, step].sum(-1)[..., None, None]
    torch.testing.assert_close(states[:, :, 4], expected)


def test_rollout_is_differentiable_in_state_and_actions(scenes):
    scene = scenes["pendulum"]
    model = as_model(lambda state, action: torch.sin(state) * 0.9 + action.sum(-1)[..., None, None].tanh(), scene)
    state = random_states(scene, 2).requires_grad_()
    actions = torch.randn(2, 3, 1, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda s, a: rollout(model, s, a)[:, -1], (state, actions))
    with torch.no_grad():
        assert not rollout(model, state, actions).requires_grad


def test_rollout_without_batch_or_steps(scenes):
    scene = scenes["pendulum"]
    model = as_model(lambda state, action: state + 1, scene)
    state = random_states(scene)
    assert rollout(model, state, torch.zeros(2, 1)).shape == (3, 2, 13)
    torch.testing.assert_close(rollout(model, state, torch.zeros(0, 1)), state[None])


def test_wrong_shapes_are_named(scenes):
    model = as_model(lambda state, action: state, scenes["pendulum"])
    with pytest.raises(ValueError, match=r"\[2, 2, 13\] and \[3, 4, 1\]"):
        rollout(model, random_states(scenes["pendulum"], 2), torch.zeros(3, 4, 1))
