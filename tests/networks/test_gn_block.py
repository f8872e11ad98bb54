"""The GN block and the core against Algorithm 1 written as loops, their symmetries and gradients."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchrl_gn.identification import InferenceModel
from torchrl_gn.networks import GNBlock, GNCore, Graph, GraphSize, graph_concat

# Multi-edges (0 -> 1 twice), a self-loop at 2, node 3 without edges, node 4 that only sends.
EDGES = torch.tensor([[0, 1, 0, 2, 4, 2], [1, 0, 1, 2, 2, 1]])
NODES = 5
HIDDEN = {"edge_hidden": (7,), "node_hidden": (6, 5), "global_hidden": (4,)}


def algorithm_1(block: GNBlock, graph: Graph) -> Graph:
    """The paper's Algorithm 1, edge by edge and node by node, for a graph without batch."""
    globals_ = graph.globals_
    edges, received = [], [torch.zeros(block.out_size.edges, dtype=globals_.dtype) for _ in graph.nodes]
    for edge, (sender, receiver) in zip(graph.edges, graph.edge_index.T.tolist(), strict=True):
        edges.append(block.edge_mlp(torch.cat((globals_, graph.nodes[sender], graph.nodes[receiver], edge))))
        received[receiver] = received[receiver] + edges[-1]
    nodes = [block.node_mlp(torch.cat((globals_, n, r))) for n, r in zip(graph.nodes, received, strict=True)]
    out = globals_  # passes through where it is not updated
    if block.global_mlp is not None:
        out = block.global_mlp(torch.cat((globals_, sum(nodes), sum(received))))
    stacked = torch.stack(edges) if edges else torch.zeros(0, block.out_size.edges, dtype=globals_.dtype)
    return Graph(torch.stack(nodes), stacked, out, graph.edge_index)


def assert_same_graph(a: Graph, b: Graph, tolerance: float = 1e-13) -> None:
    assert torch.equal(a.edge_index, b.edge_index)
    for part in ("nodes", "edges", "globals_"):
        torch.testing.assert_close(getattr(a, part), getattr(b, part), rtol=0, atol=tolerance)


def make_block(in_size: GraphSize, out_size: GraphSize) -> GNBlock:
    torch.manual_seed(0)
    return GNBlock(in_size, out_size, **HIDDEN).double()


def make_core(size: GraphSize) -> GNCore:
    torch.manual_seed(0)
    return GNCore(size, GraphSize(0, 0, 0), 4, latent=8, **HIDDEN).double()


def relabel(graph: Graph, nodes: Tensor, edges: Tensor) -> Graph:
    """The same graph with its nodes and its edges listed in another order."""
    place = torch.empty_like(nodes)
    place[nodes] = torch.arange(len(nodes))
    return Graph(
        graph.nodes[..., nodes, :],
        graph.edges[..., edges, :],
        graph.globals_,
        place[graph.edge_index[:, edges]],
    )


@pytest.mark.parametrize("out_globals", [0, 3])
@pytest.mark.parametrize("in_globals", [0, 2])
def test_block_is_algorithm_1(random_graph, in_globals, out_globals):
    size = GraphSize(3, 2, in_globals)
    block = make_block(size, GraphSize(4, 5, out_globals))
    graph = random_graph(size, EDGES, NODES)
    assert_same_graph(block(graph), algorithm_1(block, graph))


@pytest.mark.parametrize("edge_index", [EDGES, torch.zeros(2, 0, dtype=torch.long), torch.tensor([[0], [0]])])
@pytest.mark.parametrize("batch", [(3,), (2, 3)])
def test_batches_are_independent_graphs(random_graph, edge_index, batch):
    size = GraphSize(3, 2, 1)
    block = make_block(size, GraphSize(4, 5, 3))
    graph = random_graph(size, edge_index, NODES, *batch)
    out = block(graph)
    for index in torch.cartesian_prod(*(torch.arange(n) for n in batch)).reshape(-1, len(batch)).tolist():
        where = tuple(index)
        one = Graph(graph.nodes[where], graph.edges[where], graph.globals_[where], edge_index)
        got = Graph(out.nodes[where], out.edges[where], out.globals_[where], edge_index)
        assert_same_graph(got, algorithm_1(block, one))


def test_means_do_not_tell_one_graph_from_two_copies_of_it(random_graph):
    graph = random_graph(GraphSize(3, 2, 4), EDGES, NODES)
    two = Graph(
        torch.cat((graph.nodes, graph.nodes), -2),
        torch.cat((graph.edges, graph.edges), -2),
        graph.globals_,
        torch.cat((EDGES, EDGES + NODES), 1),
    )
    for pool, same in (("mean", True), ("sum", False)):
        torch.manual_seed(0)
        block = GNBlock(GraphSize(3, 2, 4), GraphSize(3, 2, 5), pool=pool, **HIDDEN).double()
        one, both = block(graph), block(two)
        assert torch.allclose(one.globals_, both.globals_, rtol=0, atol=1e-13) is same
        torch.testing.assert_close(both.nodes[..., :NODES, :], one.nodes, rtol=0, atol=1e-13)
    empty = Graph(graph.nodes, graph.edges[..., :0, :], graph.globals_, EDGES[:, :0])
    assert GNBlock(GraphSize(3, 2, 4), GraphSize(3, 2, 5), pool="mean").double()(empty).globals_.isfinite().all()
    with pytest.raises(ValueError, match="pool='max' is not known"):
        GNBlock(GraphSize(3, 2, 4), GraphSize(3, 2, 5), pool="max")  # pyright: ignore[reportArgumentType]


def test_without_a_global_update_none_is_built():
    block = GNBlock(GraphSize(3, 2, 4), GraphSize(5, 6, 0), **HIDDEN)
    assert block.global_mlp is None
    assert not any("global" in name for name, _ in block.named_parameters())


def test_core_is_two_blocks_and_a_skip(random_graph):
    core = make_core(GraphSize(3, 2, 1))
    graph = random_graph(GraphSize(3, 2, 1), EDGES, NODES)
    between = algorithm_1(core.first, graph)
    assert_same_graph(core(graph), algorithm_1(core.second, graph_concat(graph, between)))


@pytest.mark.parametrize("kind", ["block", "core"])
def test_relabelling_nodes_and_edges_relabels_the_output(random_graph, kind):
    size = GraphSize(3, 2, 2)
    function = make_block(size, GraphSize(4, 5, 3)) if kind == "block" else make_core(size)
    graph = random_graph(size, EDGES, NODES, 2)
    nodes, edges = torch.randperm(NODES), torch.randperm(EDGES.shape[1])
    assert_same_graph(function(relabel(graph, nodes, edges)), relabel(function(graph), nodes, edges))


def test_a_node_without_edges_hears_others_only_through_globals(random_graph):
    size = GraphSize(3, 2, 1)
    block = make_block(size, GraphSize(4, 5, 3))
    graph = random_graph(size, EDGES, NODES)
    graph.nodes.requires_grad_()
    gradient = torch.autograd.grad(block(graph).nodes[3].sum(), graph.nodes)[0]
    assert gradient[3].abs().sum() > 0
    assert torch.equal(gradient[[0, 1, 2, 4]], torch.zeros(4, 3).double())
    core = make_core(size)
    gradient = torch.autograd.grad(core(graph).nodes[3].sum(), graph.nodes)[0]
    assert (gradient.abs().sum(-1) > 0).all()


def test_gradients_are_the_finite_differences(random_graph):
    size = GraphSize(2, 2, 1)
    block = make_block(size, GraphSize(3, 2, 2))
    graph = random_graph(size, EDGES, NODES, 2)
    leaves = [part.requires_grad_() for part in (graph.nodes, graph.edges, graph.globals_)]
    names, weights = zip(*block.named_parameters(), strict=True)

    def run(nodes, edges, globals_, *values):
        graph = Graph(nodes, edges, globals_, EDGES)
        out = torch.func.functional_call(block, dict(zip(names, values, strict=True)), (graph,))
        return out.nodes, out.edges, out.globals_

    assert torch.autograd.gradcheck(run, (*leaves, *weights), fast_mode=True)


def test_a_core_without_hidden_layers_is_refused():
    with pytest.raises(ValueError, match=r"needs a hidden layer, got edges \(8,\), nodes \(\)"):
        GNCore(GraphSize(3, 2, 1), GraphSize(0, 0, 0), 4, edge_hidden=(8,), node_hidden=(), global_hidden=(8,))


def test_an_unknown_activation_is_named_by_every_network():
    size = GraphSize(3, 2, 1)
    for make in (lambda: GNBlock(size, size, activation="sin"), lambda: InferenceModel(size, activation="sin")):
        with pytest.raises(ValueError, match=r"activation='sin' is not known; use one of \['relu', 'silu', "):
            make()


def test_it_prints_its_layers():
    shown = str(GNBlock(GraphSize(5, 2, 1), GraphSize(16, 8, 0), edge_hidden=(64,), node_hidden=(32,)))
    assert "in_features=13, out_features=64" in shown and "in_features=32, out_features=16" in shown
