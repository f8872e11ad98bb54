"""Training in C++ is training by torch operations: loss and gradients of all weights."""

from __future__ import annotations

import pytest
import torch

from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.dynamics.executors import EagerExecutor
from torchrl_gn.objectives import ForwardModelLoss


@pytest.mark.parametrize("name", ["pendulum", "swimmer6", "falling"])
@pytest.mark.parametrize("core", ["gn", "mlp"])
@pytest.mark.parametrize("steps", [1, 3])
def test_losses_and_gradients_of_weights_are_those_of_torch(
    scenes, fit, random_states, random_actions, monkeypatch, name, core, steps
):
    scene = scenes[name]
    torch.manual_seed(0)
    sizes = {"hidden": (12, 10)} if core == "mlp" else {"latent": 8, "hidden": (12, 10)}
    model = fit(ForwardModel.for_scene(scene, core=core, **sizes).double(), scene)
    bound = model.bind(scene)
    loss = ForwardModelLoss(bound)
    state, action = random_states(scene, 60, scale=0.1), random_actions(scene, 60)
    windows = bound.own_parameters().new_zeros(60)
    windows["state"], windows["action"] = state, action
    windows["next", "state"] = random_states(scene, 60, scale=0.1, seed=1)
    loss.fit_scales(windows)
    if steps > 1:
        windows = torch.stack([windows] * steps, 1)
    results = []
    for native in (False, True):
        if not native:
            monkeypatch.setattr(
                bound, "training_executor", lambda parameters: EagerExecutor(bound.program(parameters, reduced=True))
            )
        else:
            monkeypatch.undo()
        model.zero_grad()
        value = loss(windows)["loss_forward_model"]
        value.backward()
        results.append((value.detach(), *(weight.grad for weight in model.parameters() if weight.grad is not None)))
    assert bound.training_executor().reason is None
    assert len(results[0]) == len(results[1]) > 5
    for expected, found in zip(*results, strict=True):
        assert (found - expected).norm() <= 1e-10 * expected.norm()


def test_gradients_are_those_of_the_weights_that_predicted(scenes, make_model, random_states, random_actions):
    scene = scenes["pendulum"]
    model = make_model(scene).double()
    bound, inputs, weight = model.bind(scene), (random_states(scene, 2), random_actions(scene, 2)), None
    gradients = []
    for changes in (False, True):
        change, _ = bound.training_executor().delta(*inputs)
        if changes:
            with torch.no_grad():
                for weight in model.core.parameters():
                    weight.data = 2 * weight.data  # unseen by autograd's own check
            bound.training_executor().delta(*inputs)
        gradients.append(torch.autograd.grad(change.sum(), model.core.second.node_mlp[-1].bias, retain_graph=True)[0])
        torch.autograd.grad(change.sum(), model.core.second.node_mlp[-1].bias)
    torch.testing.assert_close(*gradients)


def test_gradients_of_weights_do_not_depend_on_threads(scenes, fit, random_states, random_actions):
    scene = scenes["swimmer6"]
    torch.manual_seed(0)
    model = fit(ForwardModel.for_scene(scene, latent=8, hidden=(12, 10)), scene)
    # Folded once: torch's own sums in it may depend on threads.
    executor, before, found = model.bind(scene).training_executor(), torch.get_num_threads(), []
    weights = [mlp[2].weight for mlp in (model.core.first.edge_mlp, model.core.second.node_mlp)]
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            change, _ = executor.delta(random_states(scene, 130), random_actions(scene, 130))
            found.append(torch.autograd.grad(change, weights, torch.ones_like(change), retain_graph=True))
    finally:
        torch.set_num_threads(before)
    for others in found[1:]:
        assert all(map(torch.equal, found[0], others))
