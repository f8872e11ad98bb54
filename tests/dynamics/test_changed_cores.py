"""A user's changes of a model's core take effect in every way to predict and to train."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torch.nn.utils import prune

from torchrl_gn.dynamics import specialize
from torchrl_gn.networks.tensor_tree import copy_of
from torchrl_gn.objectives import ForwardModelLoss

from ..compiling import compiles


def with_dropout(core: nn.Module):
    for mlp in (core.first.edge_mlp, core.second.node_mlp):
        mlp[1] = nn.Sequential(mlp[1], nn.Dropout(0.5))


def with_tanh(core: nn.Module):
    core.second.node_mlp[1] = nn.Tanh()


def with_hook(core: nn.Module):
    core.first.edge_mlp[0].register_forward_hook(lambda module, inputs, out: 2 * out)


def pruned(core: nn.Module):
    prune.random_unstructured(core.second.node_mlp[0], "weight", amount=0.5)


@pytest.mark.parametrize("change", [with_tanh, with_hook, pruned])
def test_changes_take_effect(scenes, make_model, random_states, random_actions, change):
    scene = scenes["pendulum"]
    model = make_model(scene)
    state, action = random_states(scene, 5), random_actions(scene, 5)
    before = model.bind(scene).step(state, action)[0]
    change(model.core)
    bound, reference = model.bind(scene), model.bind(scene, reference=True)
    expected = reference.step(state, action)[0]
    assert not torch.allclose(expected, before, rtol=0, atol=1e-9)
    torch.testing.assert_close(bound.step(state, action)[0], expected, rtol=0, atol=0)
    torch.testing.assert_close(bound.rollout(state, action[:, None])[0][:, 1], expected, rtol=0, atol=0)
    with torch.no_grad():
        reference.step(state, action)
        fast = specialize(bound)
        torch.testing.assert_close(fast.step(state, action)[0], expected, rtol=1e-6, atol=1e-9)
    assert fast.reason is not None


def test_dropout_follows_the_mode(scenes, make_model, random_states, random_actions):
    scene = scenes["pendulum"]
    model = make_model(scene)
    state, action = random_states(scene, 5), random_actions(scene, 5)
    expected = model.bind(scene).step(state, action)[0]
    with_dropout(model.core)
    bound = model.bind(scene)
    for predictor in (bound, specialize(bound)):
        first, second = (predictor.step(state, action)[0] for _ in range(2))
        assert not torch.equal(first, second)
    model.eval()
    for predictor in (bound, specialize(bound)):
        torch.testing.assert_close(predictor.step(state, action)[0], expected, rtol=1e-6, atol=1e-9)


def test_losses_train_what_was_changed(scenes, make_model, random_states, random_actions):
    scene = scenes["pendulum"]
    model = make_model(scene)
    with_hook(model.core)
    state = random_states(scene, 8)
    after = {"state": random_states(scene, 8, seed=1)}
    batch = TensorDict({"state": state, "action": random_actions(scene, 8), "next": after}, [8])
    gradients = []
    for reference in (False, True):
        loss = ForwardModelLoss(model.bind(scene, reference=reference), noise=0)
        value = loss(batch)["loss_forward_model"]
        gradients.append(torch.autograd.grad(value, list(model.core.parameters()), allow_unused=True))
    for got, expected in zip(*gradients, strict=True):
        torch.testing.assert_close(got, expected)


@compiles
def test_a_changed_core_is_not_compiled(scenes, make_model):
    model = make_model(scenes["pendulum"])
    with_hook(model.core)
    with pytest.raises(TypeError, match="evaluated by message passing: use executor='eager'"):
        specialize(model.bind(scenes["pendulum"]), executor="compiled")


def test_copies_keep_what_was_changed(scenes, make_model):
    """One weight is computed from others, in an autograd graph."""
    core = make_model(scenes["pendulum"]).core
    pruned(core)
    with_hook(core)
    assert not core.second.node_mlp[0].weight.is_leaf
    twin = copy_of(core)
    assert torch.equal(twin.second.node_mlp[0].weight, core.second.node_mlp[0].weight)
    assert twin.second.node_mlp[0].weight_orig is not core.second.node_mlp[0].weight_orig
    assert len(twin.first.edge_mlp[0]._forward_hooks) == 1
