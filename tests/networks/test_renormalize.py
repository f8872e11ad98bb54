"""Networks whose outputs are normalised anew."""

from __future__ import annotations

import pytest
import torch
from torch.nn.utils import parametrizations, prune

from torchrl_gn.maths.normalizer import Normalizer
from torchrl_gn.networks.layer_norm_mlp import LayerNormMLP, renormalize


@pytest.mark.parametrize(("hidden", "linear"), [([8], False), ([8, 4], False), ([8, 4], True)])
def test_predicts_what_it_did(hidden: list[int], linear: bool) -> None:
    torch.manual_seed(0)
    networks, normalizer = [LayerNormMLP(3, 1, hidden, linear=linear) for _ in range(2)], Normalizer(1)
    for network in networks:
        if network.linear is not None:
            torch.nn.init.normal_(network.linear.weight)
    renormalize(networks, normalizer, torch.randn(100, 1))
    inputs = torch.randn(20, 3)
    before = [normalizer.inverse(network(inputs)) for network in networks]
    values = 30 * torch.rand(50, 2, 1) - 7
    renormalize(networks, normalizer, values)
    for network, old in zip(networks, before, strict=True):
        torch.testing.assert_close(normalizer.inverse(network(inputs)), old, rtol=1e-4, atol=1e-4)
    assert normalizer.mean.item() == pytest.approx(values.mean().item(), rel=1e-5)
    assert normalizer.std.item() == pytest.approx(values.std(correction=0).item(), rel=1e-5)


def test_values_that_are_all_alike() -> None:
    torch.manual_seed(0)
    network, normalizer = LayerNormMLP(3, 1, [8]), Normalizer(1)
    renormalize([network], normalizer, torch.full((7, 1), 2.0), constant=0.5)
    assert normalizer.std.item() == pytest.approx(0.5) and normalizer.mean.item() == pytest.approx(2.0)
    fresh = network(inputs := torch.randn(4, 3))
    renormalize([network], normalizer, torch.full((7, 1), 2.0))
    assert normalizer.std.item() == 0
    torch.testing.assert_close(normalizer.inverse(network(inputs)), torch.full((4, 1), 2.0))
    assert fresh.std() > 0


@pytest.mark.parametrize(
    "change",
    [
        lambda network: parametrizations.weight_norm(network.rest[-1]),
        lambda network: prune.l1_unstructured(network.rest[-1], "weight", 2),
        lambda network: network.linear.register_forward_hook(lambda module, inputs, output: 2 * output),
        lambda network: network.rest.append(torch.nn.Dropout(0.5)),
    ],
    ids=["weight norm", "pruning", "hook", "another layer"],
)
def test_changed_last_layers_are_refused(change) -> None:
    """Their weights cannot be scaled: predictions jumped with the scale, silently."""
    network, normalizer = LayerNormMLP(3, 1, [8, 4], linear=True), Normalizer(1)
    renormalize([network], normalizer, torch.randn(100, 1))
    change(network)
    before, old = network.eval()(inputs := torch.randn(4, 3)), normalizer.mean.clone()
    with pytest.raises(ValueError, match="The last layer of a network, .*, was changed"):
        renormalize([network], normalizer, torch.randn(100, 1))
    assert torch.equal(network(inputs), before) and torch.equal(normalizer.mean, old)
