"""Joining and splitting graphs of one topology."""

from __future__ import annotations

import pytest
import torch

from torchrl_gn.networks import Graph, GraphSize, graph_concat, graph_split

EDGES = torch.tensor([[0, 1, 1], [1, 0, 2]])


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_split_undoes_concat(random_graph, batch):
    first = random_graph(GraphSize(2, 3, 4), EDGES, 3, *batch)
    second = random_graph(GraphSize(1, 0, 5), EDGES, 3, *batch, seed=1)
    joined = graph_concat(first, second)
    assert joined.nodes.shape == (*batch, 3, 3)
    for got, expected in zip(graph_split(joined, (2, 3, 4)), (first, second), strict=True):
        for part in ("nodes", "edges", "globals_", "edge_index"):
            assert torch.equal(getattr(got, part), getattr(expected, part))


def test_a_graph_without_batch_joins_any_batch(random_graph):
    dynamic = random_graph(GraphSize(2, 1, 1), EDGES, 3, 5, 4)
    static = random_graph(GraphSize(3, 3, 3), EDGES, 3, seed=1)
    everywhere = Graph(
        static.nodes.expand(5, 4, 3, 3),
        static.edges.expand(5, 4, 3, 3),
        static.globals_.expand(5, 4, 3),
        EDGES,
    )
    for joined, expected in (
        (graph_concat(dynamic, static), graph_concat(dynamic, everywhere)),
        (graph_concat(static, dynamic), graph_concat(everywhere, dynamic)),
    ):
        for part in ("nodes", "edges", "globals_"):
            assert torch.equal(getattr(joined, part), getattr(expected, part))


def test_sizes_add_as_concatenated_graphs_do(random_graph):
    a, b = GraphSize(1, 2, 3), GraphSize(4, 0, 6)
    joined = graph_concat(random_graph(a, EDGES, 3), random_graph(b, EDGES, 3))
    assert a + b == GraphSize(joined.nodes.shape[-1], joined.edges.shape[-1], joined.globals_.shape[-1])
