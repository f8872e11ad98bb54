"""The graph network block, Algorithm 1 of the paper, on PyG message passing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch_geometric.nn import MessagePassing
from torchrl.modules import MLP

from torchrl_gn.modules.graph import Graph
from torchrl_gn.modules.linear import ACTIVATIONS


@dataclass(frozen=True)
class GraphSize:
    """Numbers of features of a graph's nodes, edges and globals."""

    nodes: int
    edges: int
    globals_: int

    def __add__(self, other: GraphSize) -> GraphSize:
        return GraphSize(self.nodes + other.nodes, self.edges + other.edges, self.globals_ + other.globals_)


class GNBlock(MessagePassing):
    r"""Graph network block: graph in, graph of the same topology out.

    .. math::
        e^*_j &= f_e(g, n_{s_j}, n_{r_j}, e_j) \\
        n^*_i &= f_n(g, n_i, \textstyle\sum_{j: r_j = i} e^*_j) \\
        g^*   &= f_g(g, \textstyle\sum_i n^*_i, \textstyle\sum_j e^*_j)

    with MLPs for the three functions, an activation between layers and none after the last.

    Args:
        in_size: features of the input graph.
        out_size: features of the output graph; with ``globals_=0`` the global update is
            neither built nor computed.
        edge_hidden: hidden sizes of the edge MLP.
        node_hidden: hidden sizes of the node MLP.
        global_hidden: hidden sizes of the global MLP.
        activation: ``"relu"`` (paper), ``"silu"``, ``"gelu"`` or ``"tanh"``.
    """

    def __init__(
        self,
        in_size: GraphSize,
        out_size: GraphSize,
        *,
        edge_hidden: Sequence[int] = (128, 128),
        node_hidden: Sequence[int] = (128, 128),
        global_hidden: Sequence[int] = (128, 128),
        activation: str = "relu",
    ) -> None:
        super().__init__(aggr="sum", node_dim=-2)
        self.in_size, self.out_size = in_size, out_size
        g, n, e = in_size.globals_, in_size.nodes, in_size.edges
        self.edge_mlp = _mlp(g + 2 * n + e, edge_hidden, out_size.edges, activation)
        self.node_mlp = _mlp(g + n + out_size.edges, node_hidden, out_size.nodes, activation)
        self.global_mlp = None
        if out_size.globals_:
            self.global_mlp = _mlp(g + out_size.nodes + out_size.edges, global_hidden, out_size.globals_, activation)

    def forward(self, graph: Graph) -> Graph:
        """``[*B, N, F]``, ``[*B, E, F]``, ``[*B, F]`` features in, the same shapes out."""
        # edge_updater_type: (nodes: Tensor, edges: Tensor, globals_: Tensor)
        edges = self.edge_updater(graph.edge_index, nodes=graph.nodes, edges=graph.edges, globals_=graph.globals_)
        num_nodes = graph.nodes.shape[-2]
        # propagate_type: (edges: Tensor)
        received = self.propagate(graph.edge_index, edges=edges, size=(num_nodes, num_nodes))
        globals_ = graph.globals_
        nodes = self.node_mlp(torch.cat((_per_item(globals_, num_nodes), graph.nodes, received), dim=-1))
        if self.global_mlp is None:
            globals_ = globals_[..., :0]
        else:
            globals_ = self.global_mlp(torch.cat((globals_, nodes.sum(-2), edges.sum(-2)), dim=-1))
        return Graph(nodes, edges, globals_, graph.edge_index)

    def edge_update(self, nodes_j: Tensor, nodes_i: Tensor, edges: Tensor, globals_: Tensor) -> Tensor:
        globals_ = _per_item(globals_, edges.shape[-2])
        return self.edge_mlp(torch.cat((globals_, nodes_j, nodes_i, edges), dim=-1))

    def message(self, edges: Tensor) -> Tensor:
        return edges


def _mlp(in_features: int, hidden: Sequence[int], out_features: int, activation: str) -> MLP:
    return MLP(in_features, out_features, num_cells=list(hidden), activation_class=ACTIVATIONS[activation])


def _per_item(globals_: Tensor, count: int) -> Tensor:
    return globals_.unsqueeze(-2).expand(*globals_.shape[:-1], count, globals_.shape[-1])
