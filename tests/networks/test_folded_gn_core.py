"""The folded core is the core: outputs and gradients, on any topology."""

from __future__ import annotations

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchrl_gn.dynamics.bound import dynamic_graph, static_graph
from torchrl_gn.networks import GNCore, Graph, GraphSize, Incidence, folded_gn_core, graph_concat
from torchrl_gn.networks.fold_gn_core import fold_gn_core

NOTHING = GraphSize(0, 0, 0)
PARTS = ("nodes", "edges", "globals_")

maths = settings(
    max_examples=40,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@st.composite
def topologies(draw) -> tuple[int, Tensor]:
    """1 to 6 nodes and up to 10 edges: self-loops, multi-edges and isolated nodes included."""
    num_nodes = draw(st.integers(1, 6))
    node = st.integers(0, num_nodes - 1)
    edges = draw(st.lists(st.tuples(node, node), max_size=10))
    return num_nodes, torch.tensor(edges, dtype=torch.long).reshape(-1, 2).T


def make_core(size: GraphSize, out: int, latent: int, depth: int, seed: int = 0) -> GNCore:
    torch.manual_seed(seed)
    hidden = {"edge_hidden": [7] * depth, "node_hidden": [6] * depth, "global_hidden": [5] * depth}
    return GNCore(size, NOTHING, out, latent=latent, **hidden).double()


def outputs_and_gradients(function, core: GNCore, dynamic: Graph, cotangent: Tensor):
    """Output nodes, and gradients in dynamic features and in every weight."""
    leaves = [part.detach().requires_grad_() for part in (dynamic.nodes, dynamic.edges, dynamic.globals_)]
    out = function(Graph(*leaves, dynamic.edge_index))
    wanted = [*leaves, *core.parameters()]
    gradients = torch.autograd.grad((out * cotangent).sum(), wanted, allow_unused=True)
    return [
        out.detach(),
        *(torch.zeros_like(x) if g is None else g for x, g in zip(wanted, gradients, strict=True)),
    ]


def folded(core: GNCore, dynamic: Graph, static: Graph, predicted: Tensor) -> Tensor:
    size = GraphSize(*(part.shape[-1] for part in (dynamic.nodes, dynamic.edges, dynamic.globals_)))
    incidence = Incidence(static.edge_index, static.nodes.shape[-2], predicted)
    return fold_gn_core(core, size, incidence, static).predict(dynamic)


def compare(core: GNCore, dynamic: Graph, static: Graph, predicted: Tensor, tolerance: float, dtype=torch.float64):
    """Largest-norm comparison of the two ways, ``tolerance`` relative to each tensor's norm."""
    mask = torch.zeros(dynamic.nodes.shape[-2], 1, dtype=torch.float64)
    mask[predicted] = 1
    generator = torch.Generator().manual_seed(5)
    out_size = core.second.out_size.nodes
    shape = (*dynamic.nodes.shape[:-1], out_size)
    cotangent = torch.randn(shape, generator=generator, dtype=torch.float64)
    plain = outputs_and_gradients(lambda g: mask * core(graph_concat(g, static)).nodes, core, dynamic, cotangent)

    core = core.to(dtype)
    dynamic, static = (
        Graph(g.nodes.to(dtype), g.edges.to(dtype), g.globals_.to(dtype), g.edge_index) for g in (dynamic, static)
    )
    quick = outputs_and_gradients(lambda g: folded(core, g, static, predicted), core, dynamic, cotangent.to(dtype))
    scale = max([float(x.norm()) for x in plain], default=0.0)
    for expected, got in zip(plain, quick, strict=True):
        assert got.shape == expected.shape
        error = float((got.double() - expected).norm())
        # A gradient that is zero or cancels is compared on the scale of the others.
        assert error <= tolerance * max(float(expected.norm()), 1e-2 * scale), (error, expected.norm())


@pytest.mark.slow
@maths
@given(
    topology=topologies(),
    batch=st.sampled_from([(), (1,), (3,), (2, 2), (0,)]),
    depth=st.integers(1, 3),
    latent=st.sampled_from([1, 3, 8]),
    dynamic_globals=st.sampled_from([0, 2]),
    static_size=st.sampled_from([GraphSize(0, 0, 0), GraphSize(2, 3, 1), GraphSize(1, 0, 0), GraphSize(0, 0, 2)]),
    data=st.data(),
)
def test_factors_are_the_core(random_graph, topology, batch, depth, latent, dynamic_globals, static_size, data):
    num_nodes, edge_index = topology
    size = GraphSize(3, 1, dynamic_globals)
    core = make_core(size + static_size, 4, latent, depth)
    dynamic = random_graph(size, edge_index, num_nodes, *batch)
    # Any part of the static graph may differ between samples.
    static, each = (
        random_graph(static_size, edge_index, num_nodes, seed=1),
        random_graph(static_size, edge_index, num_nodes, *batch, seed=2),
    )
    varied = data.draw(st.tuples(*[st.booleans()] * 3))
    parts = [getattr(each if vary else static, part) for vary, part in zip(varied, PARTS, strict=True)]
    static = Graph(*parts, edge_index)
    predicted = torch.tensor(data.draw(st.lists(st.integers(0, num_nodes - 1), unique=True)), dtype=torch.long)
    compare(core, dynamic, static, predicted, 1e-10)


@pytest.mark.parametrize("batch", [(16,), (4, 4)])
def test_float32_keeps_its_digits(random_graph, batch):
    chain = torch.arange(6)
    edge_index = torch.cat((torch.stack((chain, chain + 1)), torch.stack((chain + 1, chain))), dim=1)
    size, static_size = GraphSize(18, 1, 0), GraphSize(20, 30, 10)
    torch.manual_seed(0)
    core = GNCore(size, static_size, 12, hidden=32)
    # Weights that float32 holds exactly, so that only the arithmetic differs.
    core = core.double()
    dynamic = random_graph(size, edge_index, 7, *batch)
    static = random_graph(static_size, edge_index, 7, seed=1)
    dynamic, static = (
        Graph(g.nodes.float().double(), g.edges.float().double(), g.globals_.float().double(), g.edge_index)
        for g in (dynamic, static)
    )
    compare(core, dynamic, static, torch.arange(1, 7), 1e-5, torch.float32)


def test_nodes_that_are_not_predicted_are_exactly_zero(random_graph):
    edge_index = torch.tensor([[0, 1, 1, 2], [1, 0, 2, 1]])
    core = make_core(GraphSize(3, 1, 0), 4, 8, 2)
    dynamic, static = (
        random_graph(GraphSize(3, 1, 0), edge_index, 3, 5),
        random_graph(GraphSize(0, 0, 0), edge_index, 3),
    )
    out = folded(core, dynamic, static, torch.tensor([2, 1]))
    assert torch.equal(out[:, 0], torch.zeros(5, 4).double())
    torch.testing.assert_close(out[:, 1:], core(dynamic).nodes[:, 1:], rtol=0, atol=1e-13)


def test_gradients_are_the_finite_differences(random_graph):
    edge_index = torch.tensor([[0, 1, 1, 2, 1], [1, 0, 2, 1, 1]])
    size, static_size = GraphSize(2, 1, 1), GraphSize(1, 1, 1)
    core = make_core(size + static_size, 2, 3, 2)
    dynamic, static = random_graph(size, edge_index, 3, 2), random_graph(static_size, edge_index, 3, seed=1)
    leaves = [part.requires_grad_() for part in (dynamic.nodes, dynamic.edges, dynamic.globals_)]
    names, weights = zip(*core.named_parameters(), strict=True)

    class Factorized(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.core = core

        def forward(self, *features):
            return folded(self.core, Graph(*features, edge_index), static, torch.tensor([1, 2]))

    module = Factorized()

    def run(nodes, edges, globals_, *values):
        named = {f"core.{name}": value for name, value in zip(names, values, strict=True)}
        return torch.func.functional_call(module, named, (nodes, edges, globals_))

    assert torch.autograd.gradcheck(run, (*leaves, *weights), fast_mode=True)


def test_inputs_are_left_alone(random_graph):
    edge_index = torch.tensor([[0, 1], [1, 0]])
    core = make_core(GraphSize(3, 1, 2), 4, 8, 2)
    dynamic, static = (
        random_graph(GraphSize(3, 1, 2), edge_index, 2, 5),
        random_graph(GraphSize(0, 0, 0), edge_index, 2),
    )
    before = [part.clone() for part in (dynamic.nodes, dynamic.edges, dynamic.globals_)]
    folded(core, dynamic, static, torch.tensor([1]))
    assert all(map(torch.equal, before, (dynamic.nodes, dynamic.edges, dynamic.globals_)))


@pytest.mark.parametrize("name", ["pendulum", "swimmer6", "cheetah", "joints", "falling"])
def test_forward_models_compute_their_core(scenes, make_model, random_states, random_actions, name):
    """A bound model's predictions equal the plain core on its own normalised graphs."""
    scene = scenes[name]
    model = make_model(scene).double()
    bound = model.bind(scene)
    dynamic, static = (
        dynamic_graph(bound, random_states(scene, 5, seed=3), random_actions(scene, 5, seed=3)),
        static_graph(bound, bound.scene_parameters),
    )
    compare(model.core, dynamic, static, bound.incidence.predicted, 1e-10)


@pytest.mark.parametrize("batch", [1, 5, 7])
def test_large_batches_in_parts_are_the_whole(random_graph, monkeypatch, batch):
    size, edge_index = GraphSize(3, 2, 1), torch.tensor([[0, 1, 2], [1, 2, 0]])
    core = make_core(size + GraphSize(2, 0, 0), 4, 5, depth=2)
    dynamic, static = random_graph(size, edge_index, 3, batch), random_graph(GraphSize(2, 0, 0), edge_index, 3)
    ready = fold_gn_core(core, size, Incidence(edge_index, 3, torch.tensor([1, 2])), static)
    whole = ready.predict(dynamic)  # with gradients: in one
    monkeypatch.setattr(folded_gn_core, "_CACHED", 2 * 3 * 7)  # two samples of three edges with seven activations
    with torch.no_grad():
        assert len(ready._parts((dynamic.nodes.transpose(0, 1),))) == -(-batch // 2)
        torch.testing.assert_close(ready.predict(dynamic), whole.detach(), rtol=1e-12, atol=1e-12)
