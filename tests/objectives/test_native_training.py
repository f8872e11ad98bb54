"""Training in C++ is training by torch operations: loss and gradients of all weights."""

from __future__ import annotations

import pytest
import torch

from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.objectives import ForwardModelLoss


@pytest.mark.parametrize("name", ["pendulum", "swimmer6", "falling"])
@pytest.mark.parametrize("core", ["gn", "mlp"])
@pytest.mark.parametrize("steps", [1, 3])
def test_losses_and_gradients_of_weights_are_those_of_torch(
    scenes, fit, random_states, random_actions, name, core, steps
):
    scene = scenes[name]
    torch.manual_seed(0)
    sizes = {"hidden": (12, 10)} if core == "mlp" else {"latent": 8, "hidden": (12, 10)}
    model = fit(ForwardModel.for_scene(scene, core=core, **sizes).double(), scene)
    losses = [ForwardModelLoss(model.bind(scene, reference=reference)) for reference in (True, False)]
    state, action = random_states(scene, 60, scale=0.1), random_actions(scene, 60)
    windows = losses[0].model.own_parameters().new_zeros(60)
    windows["state"], windows["action"] = state, action
    windows["next", "state"] = random_states(scene, 60, scale=0.1, seed=1)
    results = []
    for loss in losses:
        loss.fit_scales(windows)
        model.zero_grad()
        value = loss(torch.stack([windows] * steps, 1) if steps > 1 else windows)["loss_forward_model"]
        value.backward()
        results.append((value.detach(), *(weight.grad for weight in model.parameters() if weight.grad is not None)))
    assert losses[1].reason is None
    assert len(results[0]) == len(results[1]) > 5
    for expected, found in zip(*results, strict=True):
        assert (found - expected).norm() <= 1e-10 * expected.norm()


def test_gradients_are_those_of_the_weights_that_predicted(scenes, make_model, random_states, random_actions):
    scene = scenes["pendulum"]
    model = make_model(scene).double()
    bound, inputs, weight = model.bind(scene), (random_states(scene, 2), random_actions(scene, 2)), None
    gradients = []
    for changes in (False, True):
        change, _ = bound.prepared_for_training().delta(*inputs)
        if changes:
            with torch.no_grad():
                for weight in model.core.parameters():
                    weight.data = 2 * weight.data  # unseen by autograd's own check
            bound.prepared_for_training().delta(*inputs)
        gradients.append(torch.autograd.grad(change.sum(), model.core.second.node_mlp[-1].bias, retain_graph=True)[0])
        torch.autograd.grad(change.sum(), model.core.second.node_mlp[-1].bias)
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize("name", ["pendulum", "swimmer6"])
def test_states_elsewhere_are_trained_on_too(scenes, fit, random_states, random_actions, name):
    """Channels that cannot move may differ from the reference pose, of all samples or of some: one graph has both."""
    scene = scenes[name]
    torch.manual_seed(0)
    model = fit(ForwardModel.for_scene(scene, latent=8, hidden=(12,)).double(), scene)
    reference, bound = model.bind(scene, reference=True), model.bind(scene)
    rest = bound.reference_state.expand(30, -1, -1)
    state = torch.where((torch.arange(30) % 3 == 0)[:, None, None], random_states(scene, 30), rest)
    actions, found = random_actions(scene, 30, 2), []
    for each in (reference, bound):
        leaves = [state.clone().requires_grad_(), actions.clone().requires_grad_()]
        prepared = each.prepared_for_training()
        first, _ = prepared.delta(leaves[0], leaves[1][:, 0])
        second, _ = prepared.delta(model.layout.apply(leaves[0], first), leaves[1][:, 1])
        value = first.square().sum() + second.sin().sum()
        weights = [weight for weight in model.core.parameters() if weight.requires_grad]
        found.append((value, *torch.autograd.grad(value, (leaves[1], *weights), allow_unused=True)))
    assert prepared.executor.reason is None
    for wanted, got in zip(*found, strict=True):
        assert (wanted is None) == (got is None)
        if wanted is not None:
            assert (got - wanted).norm() <= 1e-9 * wanted.norm()


def test_rollouts_of_bound_models_are_differentiated_in_weights(scenes, fit, random_states, random_actions):
    """Long ones run natively, in one call."""
    scene = scenes["pendulum"]
    torch.manual_seed(0)
    model = fit(ForwardModel.for_scene(scene, latent=8, hidden=(12,)).double(), scene)
    bound, reference = model.bind(scene), model.bind(scene, reference=True)
    state, actions, found = random_states(scene, 60, scale=0.1), random_actions(scene, 60, 10), []
    for each in (reference, bound):
        leaf = actions.clone().requires_grad_()
        states = each.rollout(state, leaf)[0]
        value = states[:, -1].sin().sum()
        gradients = torch.autograd.grad(value, (leaf, *model.core.parameters()), allow_unused=True)
        found.append((states, *(each for each in gradients if each is not None)))
    assert bound.prepared(size=600).executor.reason is None and bound._executors
    assert len(found[0]) == len(found[1]) > 5
    for wanted, got in zip(*found, strict=True):
        assert (got - wanted).norm() <= 1e-9 * wanted.norm()


def test_gradients_of_weights_do_not_depend_on_threads(scenes, fit, random_states, random_actions):
    scene = scenes["swimmer6"]
    torch.manual_seed(0)
    model = fit(ForwardModel.for_scene(scene, latent=8, hidden=(12, 10)), scene)
    # Folded once: torch's own sums in it may depend on threads.
    prepared, before, found = model.bind(scene).prepared_for_training(), torch.get_num_threads(), []
    weights = [mlp[2].weight for mlp in (model.core.first.edge_mlp, model.core.second.node_mlp)]
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            change, _ = prepared.delta(random_states(scene, 130), random_actions(scene, 130))
            found.append(torch.autograd.grad(change, weights, torch.ones_like(change), retain_graph=True))
    finally:
        torch.set_num_threads(before)
    for others in found[1:]:
        assert all(map(torch.equal, found[0], others))
