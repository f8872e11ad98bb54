"""A specialised predictor follows every change of its weights, and is folded no more often than that."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch

from torchrl_gn.dynamics import ForwardModel, specialize


def pull(predictor, state, action):
    """Predicted changes, and gradients of a function of them."""
    leaves = [value.clone().requires_grad_() for value in (state, action)]
    delta = predictor.delta(*leaves)
    weights = torch.linspace(-1, 1, delta.numel(), dtype=torch.float64).view_as(delta)
    return [delta.detach(), *torch.autograd.grad((delta * weights).sum(), leaves)]


def change_in_place(model: ForwardModel) -> None:
    with torch.no_grad():
        next(model.parameters()).mul_(1.5)


def load_others(model: ForwardModel) -> None:
    state = {name: value * 1.5 if "core" in name else value for name, value in model.state_dict().items()}
    model.load_state_dict(state)


def assign_others(model: ForwardModel) -> None:
    state = {name: value * 1.5 if "core" in name else value for name, value in model.state_dict().items()}
    model.load_state_dict(state, assign=True)


def step_optimizer(model: ForwardModel) -> None:
    for parameter in model.parameters():
        parameter.grad = torch.ones_like(parameter)
    torch.optim.Adam(model.parameters(), lr=0.1).step()


def more_statistics(model: ForwardModel) -> None:
    model.residual_normalizer.update(5 * torch.randn(50, 12, dtype=torch.float64))


def cast_and_back(model: ForwardModel) -> None:
    model.half().double()


CHANGES = [change_in_place, load_others, assign_others, step_optimizer, more_statistics, cast_and_back]


@pytest.mark.parametrize("change", CHANGES)
def test_a_changed_model_is_never_predicted_with_its_old_weights(
    scenes, make_model, random_states, random_actions, change
):
    scene = scenes["swimmer6"]
    model = make_model(scene).double()
    bound = model.bind(scene)
    quick = specialize(bound)
    state, action = random_states(scene, 3), random_actions(scene, 3)
    before = quick.step(state, action)[0]
    change(model)
    after = quick.step(state, action)[0]
    assert (after - before).abs().max() > 1e-7
    torch.testing.assert_close(after, bound.step(state, action)[0].detach(), rtol=0, atol=1e-12)


def test_an_unchanged_model_is_folded_once(scenes, make_model, random_states, random_actions, folds):
    scene = scenes["swimmer6"]
    quick = specialize(make_model(scene).bind(scene))
    state, action = random_states(scene, 3), random_actions(scene, 3)
    first = quick.step(state, action)[0]
    assert torch.equal(quick.step(state, action)[0], first) and len(folds) == 1
    twin = copy.deepcopy(quick)
    change_in_place(twin.model)
    assert not torch.equal(twin.step(state, action)[0], first)
    assert torch.equal(quick.step(state, action)[0], first) and len(folds) == 2


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda quick: pickle.loads(pickle.dumps(quick))])
@pytest.mark.parametrize("core", ["gn", "recurrent"])
def test_copies_predict_alike_and_share_nothing(scenes, make_model, random_states, random_actions, copied, core):
    scene = scenes["swimmer6"]
    quick = specialize(make_model(scene, core=core).bind(scene))
    state, actions = random_states(scene, 3, scale=0.1), random_actions(scene, 3, 2)
    before, _ = quick.rollout(state, actions)
    twin = copied(quick)
    assert (twin.executor_name, twin.dtype, twin.in_keys) == (quick.executor_name, quick.dtype, quick.in_keys)
    assert torch.equal(twin.rollout(state, actions)[0], before)
    change_in_place(twin.model)
    assert not torch.equal(twin.rollout(state, actions)[0], before)
    assert torch.equal(quick.rollout(state, actions)[0], before)


def test_a_change_through_data_is_unseen_until_refresh(scenes, make_model, random_states, random_actions):
    scene = scenes["swimmer6"]
    model = make_model(scene).double()
    bound = model.bind(scene)
    quick = specialize(bound)
    state, action = random_states(scene, 3), random_actions(scene, 3)
    before = quick.step(state, action)[0]
    for parameter in model.parameters():
        parameter.data.mul_(1.5)
    assert torch.equal(quick.step(state, action)[0], before)
    quick.refresh()
    after = quick.step(state, action)[0]
    assert (after - before).abs().max() > 1e-7
    torch.testing.assert_close(after, bound.step(state, action)[0].detach(), rtol=0, atol=1e-12)


def test_inference_mode_leaves_nothing_behind(scenes, make_model, random_states, random_actions):
    """Folded inside, differentiated and folded again outside; and values made inside are never taken for the same."""
    scene = scenes["swimmer6"]
    model = make_model(scene).double()
    bound = model.bind(scene, parameters_key="parameters")
    quick = specialize(bound)
    state, action = random_states(scene, 3), random_actions(scene, 3)
    with torch.inference_mode():
        parameters = bound.parameters_of(scene).clone()
        quick.step(state, action, parameters)
        parameters["nodes"].mul_(1.5)
        torch.testing.assert_close(quick.step(state, action, parameters)[0], bound.step(state, action, parameters)[0])
    for change in (lambda model: None, change_in_place):
        change(model)
        found, expected = (pull(module, state, action) for module in (quick, bound))
        for one, other in zip(found, expected, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-12)
