"""A user's changes of a core take effect: a core is folded only if it is exactly what its fold knows."""

from __future__ import annotations

import re

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torch.nn.modules.module import register_module_forward_hook
from torch.nn.utils import prune
from torch.nn.utils.parametrizations import spectral_norm, weight_norm
from torch_geometric.nn.aggr import MeanAggregation

from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.networks import GNBlock, GNCore, GraphSize, Incidence, MLPCore, RecurrentCore, UnfoldedCore, graph_split
from torchrl_gn.networks.core import dtype_of

EDGES = torch.tensor([[0, 1, 1, 2], [1, 0, 2, 1]])
DYNAMIC, STATIC, HIDDEN = GraphSize(3, 2, 1), GraphSize(2, 1, 1), GraphSize(2, 2, 2)
CORES = {"gn": GNCore, "mlp": MLPCore, "recurrent": RecurrentCore}


class Adapter(nn.Module):
    """A linear layer with a low-rank update."""

    def __init__(self, linear: nn.Linear) -> None:
        super().__init__()
        self.linear = linear
        self.down, self.up = nn.Linear(linear.in_features, 1).double(), nn.Linear(1, linear.out_features).double()

    def forward(self, x):
        return self.linear(x) + self.up(self.down(x))


class Doubled(nn.Linear):
    def forward(self, input):
        return 2 * super().forward(input)


def doubled(linear: nn.Linear) -> nn.Linear:
    linear.__class__ = Doubled
    return linear


def replaced(kind: type[nn.Module], new):
    """Exchange all modules of a kind for ``new(module)``, or change them in place if it returns None."""

    def change(core: nn.Module):
        for parent in list(core.modules()):
            for name, child in parent.named_children():
                if type(child) is kind and (other := new(child)) is not None:
                    setattr(parent, name, other)

    return change


def last(change):
    """Change the last linear layer that counts."""

    def changed(core: nn.Module):
        layers = core.mlp if isinstance(core, MLPCore) else getattr(core, "core", core).second.node_mlp
        return change(layers[-1])

    return changed


def doubled_norm(layer: nn.Module):
    with torch.no_grad():
        layer.parametrizations.weight.original0.mul_(2)


def own_forward(module: nn.Module):
    module.forward = lambda x: 2 * nn.functional.linear(x, module.weight, module.bias)


def without_bias(module: nn.Module):
    module.bias = None


def twice(core, inputs, graph):
    return type(graph)(2 * graph.nodes, graph.edges, graph.globals_, graph.edge_index)


CHANGES = {
    "dropout": (replaced(nn.SiLU, lambda each: nn.Sequential(each, nn.Dropout(0.5))), r"\[1\] is a Sequential"),
    "activation": (replaced(nn.SiLU, lambda each: nn.Tanh()), r"\[1\] is a Tanh"),
    "layer norm": (replaced(nn.SiLU, lambda each: nn.LayerNorm(6).double()), r"\[1\] is a LayerNorm"),
    "adapter": (replaced(nn.Linear, Adapter), r"\[0\] is an Adapter"),
    "own class": (last(doubled), r"\[2\] is a Doubled"),
    "hook": (last(lambda each: each.register_forward_hook(lambda module, inputs, out: 2 * out)), r"\[2\] has a hook"),
    "pre-hook": (last(lambda each: each.register_forward_pre_hook(lambda module, inputs: 2 * inputs[0])), "has a hook"),
    "core hook": (lambda core: core.register_forward_hook(twice), "it has a hook"),
    "own forward": (last(own_forward), r"\[2\] has a hook"),
    "no bias": (last(without_bias), r"\[2\] has no bias"),
    "pruned": (last(lambda each: prune.l1_unstructured(each, "weight", amount=0.5)), r"\[2\] has a hook"),
    "weight norm": (last(lambda each: doubled_norm(weight_norm(each))), "is a ParametrizedLinear"),
    "spectral norm": (last(spectral_norm), "is a ParametrizedLinear"),
}


@pytest.fixture
def fold(random_graph):
    """A core of a name, folded for a graph: its prediction and that by message passing, of the predicted nodes."""
    dynamic, static = graph_split(random_graph(DYNAMIC + STATIC, EDGES, 3, 5), (3, 2, 1))
    static = type(static)(*(part[0] for part in static.features), EDGES)

    def fold(core: nn.Module):
        predicted = torch.tensor([1, 2])
        if isinstance(core, RecurrentCore):
            start = core.update(dynamic, static, core.start(dynamic))
            graph = type(dynamic)(
                *(torch.cat(x, -1) for x in zip(dynamic.features, start.features, strict=True)), EDGES
            )
        else:
            graph = dynamic
        folded, reference = core.fold(Incidence(EDGES, 3, predicted), static), UnfoldedCore(core, static)
        return folded, folded.predict(graph)[:, predicted], reference.predict(graph)[:, predicted]

    return fold


def make(kind: str, **options) -> nn.Module:
    torch.manual_seed(0)
    options |= {"mlp": {"counts": (3, 4)}, "recurrent": {"hidden_state": (2, 2, 2)}}.get(kind, {})
    return CORES[kind](DYNAMIC, STATIC, 4, hidden=6, layers=1, **options).double().eval()


@pytest.mark.parametrize("activation", ["relu", "silu", "gelu", "tanh"])
@pytest.mark.parametrize("kind", CORES)
def test_an_unchanged_core_is_folded(fold, kind, activation):
    folded, got, expected = fold(make(kind, activation=activation))
    assert not isinstance(folded, UnfoldedCore)
    torch.testing.assert_close(got, expected)


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("kind", CORES)
def test_changes_take_effect(fold, kind, change):
    core = make(kind)
    before = fold(core)[1].detach()
    edit, reason = CHANGES[change]
    edit(core)
    folded, got, expected = fold(core.eval())
    torch.testing.assert_close(got, expected, rtol=0, atol=0)
    assert torch.allclose(got, before) == (change == "dropout")  # the identity where nothing is trained
    assert isinstance(folded, UnfoldedCore)
    assert re.search(reason, str(folded.reason))


@pytest.mark.parametrize(
    "edit",
    [
        lambda layer: layer.register_full_backward_hook(lambda module, inputs, outputs: None),
        lambda layer: layer.register_full_backward_pre_hook(lambda module, outputs: None),
    ],
)
@pytest.mark.parametrize("kind", CORES)
def test_backward_hooks_are_called(fold, kind, edit):
    core = make(kind)
    last(edit)(core)
    assert isinstance(fold(core)[0], UnfoldedCore)


def test_hooks_on_all_modules_are_called(fold):
    core, called = make("gn"), []
    handle = register_module_forward_hook(lambda module, inputs, output: called.append(module))
    try:
        fold(core)
    finally:
        handle.remove()
    assert core.first.edge_mlp in called
    assert not isinstance(fold(core)[0], UnfoldedCore)


def own_message(block: GNBlock):
    block.message = lambda edges: 2 * edges


def other_mlp(block: GNBlock):
    block.node_mlp = Adapter(nn.Linear(block.node_mlp[0].in_features, 4).double())


def other_class(block: GNBlock):
    block.__class__ = type("Block", (GNBlock,), {"message": lambda self, edges: 2 * edges})


def other_sums(block: GNBlock):
    block.aggr_module = MeanAggregation()


def other_flow(block: GNBlock):
    block.flow = "target_to_source"


BLOCKS = {
    "message": (own_message, "second has its own method"),
    "mlp": (other_mlp, "second.node_mlp is an Adapter"),
    "class": (other_class, "second is a Block"),
    "mean": (other_sums, "second.aggr_module is changed"),
    "flow": (other_flow, "second passes messages in another way"),
    "hook": (lambda block: block.register_forward_hook(twice), "second has a hook"),
    "messages": (lambda block: block.register_message_forward_hook(lambda block, inputs, out: 2 * out), "has a hook"),
}


@pytest.mark.parametrize("change", BLOCKS)
def test_changes_of_a_block_take_effect(fold, change):
    core = make("gn")
    before = fold(core)[1].detach()
    edit, reason = BLOCKS[change]
    edit(core.second)
    folded, got, expected = fold(core)
    torch.testing.assert_close(got, expected, rtol=0, atol=0)
    assert not torch.allclose(got, before)
    assert isinstance(folded, UnfoldedCore)
    assert re.search(reason, str(folded.reason))


def test_a_subclass_with_its_own_forward_runs_it(fold):
    class Doubling(GNCore):
        def forward(self, graph):
            return twice(self, (), super().forward(graph))

    core = make("gn")
    before = fold(core)[1]
    core.__class__ = Doubling
    torch.testing.assert_close(fold(core)[1], 2 * before)


@pytest.mark.parametrize("core", ["gn", "mlp"])
@pytest.mark.parametrize("wrong", [0, [2.5], "wide", [8, 0]])
def test_sizes_of_a_core_are_whole_numbers(core, wrong):
    with pytest.raises(ValueError, match="hidden=.* must be a whole number, 1 or more"):
        ForwardModel.for_scene("pendulum", core=core, hidden=wrong)


@pytest.mark.parametrize("latent", [0, 2.5])
def test_a_core_without_latent_features_is_refused(latent):
    with pytest.raises(ValueError, match=f"latent={latent} must be a whole number, 1 or more"):
        make("gn", latent=latent)


def test_options_that_no_core_has_are_named():
    with pytest.raises(TypeError, match=r"nor its core GNCore has options \['hiden'\]; the core has \['hidden', 'lay"):
        ForwardModel.for_scene("pendulum", hiden=8)


def test_removed_changes_are_folded_again(fold):
    core = make("gn")
    layer = core.first.edge_mlp[0]
    handle = layer.register_forward_hook(lambda module, inputs, output: None)
    prune.random_unstructured(layer, "weight", amount=0.5)
    assert isinstance(fold(core)[0], UnfoldedCore)
    handle.remove()
    prune.remove(layer, "weight")
    folded, got, expected = fold(core)
    assert not isinstance(folded, UnfoldedCore)
    torch.testing.assert_close(got, expected)


@pytest.mark.parametrize("kind", CORES)
def test_exchanged_weights_are_folded(fold, kind):
    """Plain tensors in place of parameters, as losses and torch.func have them."""
    core, other = make(kind), make(kind)
    with torch.no_grad():
        for weight in other.parameters():
            weight.mul_(1.1)
    with TensorDict.from_module(other).data.clone().to_module(core):
        folded, got, expected = fold(core)
    assert not isinstance(folded, UnfoldedCore)
    torch.testing.assert_close(got, fold(other)[1])
    torch.testing.assert_close(got, expected)


def test_dtype_of_changed_cores():
    core = make("gn").float()
    prune.l1_unstructured(core.first.edge_mlp[0], "weight", amount=0.5)
    assert dtype_of(core.double()) == torch.float64  # not of the weight, which is computed at the next call
    replaced(nn.Linear, lambda each: nn.Identity())(core)  # as quantised layers, which have no parameters
    assert dtype_of(core) == torch.float32
