"""A folded core's list of layers is the folded core."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from torchrl_gn.networks import GNCore, GraphSize, Incidence, MLPCore
from torchrl_gn.networks.layers import Gather, LayerList, LinearLayer
from torchrl_gn.networks.linear import ACTIVATIONS

RING = torch.tensor([[0, 1, 2], [1, 2, 0]])
TREE = torch.tensor([[0, 1, 1, 2, 1, 3, 1, 1], [1, 0, 2, 1, 3, 1, 1, 2]])  # with a loop, and one edge twice
NO_EDGES = RING[:, :0]


def evaluate(network: LayerList, nodes: Tensor, edges: Tensor) -> Tensor:
    """Prediction of nodes ``[N, B, F]`` and edges ``[E, B, F]``, by the definition of the layers."""
    buffers = [nodes, edges]

    def rows(gather: Gather) -> Tensor:
        source = buffers[gather.source]
        parts = torch.tensor_split(source[gather.items], gather.offsets[1:-1])
        return torch.stack([part.sum(0) for part in parts])

    for layer in network.layers:
        out = torch.cat([rows(gather) for gather in layer.inputs], -1) @ layer.weight.T
        if layer.table is not None:
            out = out + (layer.table[:, None] if layer.table.ndim == 2 else layer.table)
        for gather in layer.added:
            out = out + rows(gather)
        buffers.append(out if layer.activation is None else ACTIVATIONS[layer.activation]()(out))
    return buffers[-1]


def core(kind: str, sizes: tuple[GraphSize, GraphSize], counts: tuple[int, int], depth: int):
    torch.manual_seed(0)
    if kind == "mlp":
        return MLPCore(*sizes, 5, counts=counts, hidden=[6] * depth, activation="tanh").double()
    hidden: dict[str, Any] = {"edge_hidden": [7] * depth, "node_hidden": [6] * depth, "global_hidden": [4] * depth}
    return GNCore(sizes[0], sizes[1], 5, latent=3, **hidden).double()


@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("depth", [1, 3])
@pytest.mark.parametrize("kind", ["gn", "mlp"])
@pytest.mark.parametrize(("edges", "predicted"), [(RING, [0, 1, 2]), (TREE, [3, 1]), (NO_EDGES, [1])])
def test_predicts_the_same(random_graph, kind, edges, predicted, depth, own):
    sizes, num_nodes = (GraphSize(3, 2, 0), GraphSize(4, 1, 3)), 4
    dynamic, static = (random_graph(size, edges, num_nodes, 6) for size in sizes)
    if not own:  # one static graph for all samples
        static = type(static)(*(part[0] for part in static.features), edges)
    folded = core(kind, sizes, (num_nodes, edges.shape[1]), depth).fold(
        Incidence(edges, num_nodes, torch.tensor(predicted)), static
    )
    network = folded.layers()
    assert network is not None
    out = evaluate(network, dynamic.nodes.transpose(0, 1), dynamic.edges.transpose(0, 1))
    out = out if kind == "gn" else out[0].unflatten(-1, (-1, 5)).transpose(0, 1)
    torch.testing.assert_close(out, folded.predict(dynamic)[:, predicted].transpose(0, 1))


@pytest.mark.parametrize("kind", ["gn", "mlp"])
def test_refuses_globals(random_graph, kind):
    sizes = GraphSize(3, 2, 2), GraphSize(4, 1, 3)
    static = random_graph(sizes[1], RING, 3, 1)
    folded = core(kind, sizes, (3, 3), 2).fold(Incidence(RING, 3), static)
    assert folded.layers() is None


def test_gathers():
    ring = Gather.sums(0, torch.tensor([[0, 1, 1], [0, 0, 0]]))
    assert ring.offsets.tolist() == [0, 2, 2] and ring.items.tolist() == [1, 2]
    picked = Gather.picks(2, torch.tensor([1, 0]))
    assert picked.offsets.tolist() == [0, 1, 2] and picked.items.tolist() == [1, 0]
    layer = LinearLayer((ring,), torch.zeros(4, 5), None, (picked,), "silu")
    assert layer.count == 2
