"""The graph network block, Algorithm 1 of the paper, on PyG message passing."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Literal, get_args

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_gn.networks.graph import Graph, GraphSize
from torchrl_gn.networks.linear import activation_class

with warnings.catch_warnings():
    # PyG scripts functions at import, which torch 2.15 warns about.
    warnings.filterwarnings("ignore", "`torch.jit.script", FutureWarning)
    from torch_geometric.nn import MessagePassing

Pool = Literal["sum", "mean"]


class GNBlock(MessagePassing):
    r"""Graph network block: graph in, graph of the same topology out.

    .. math::
        e^*_j &= f_e(g, n_{s_j}, n_{r_j}, e_j) \\
        n^*_i &= f_n(g, n_i, \textstyle\sum_{j: r_j = i} e^*_j) \\
        g^*   &= f_g(g, \textstyle\sum_i n^*_i, \textstyle\sum_j e^*_j)

    with MLPs for the three functions, an activation between layers and none after the last.

    Args:
        in_size: features of the input graph.
        out_size: features of the output graph; a 0 omits that update and passes the input's features through.
        edge_hidden: sizes of the hidden layers of :math:`f_e`.
        node_hidden: those of :math:`f_n`.
        global_hidden: those of :math:`f_g`.
        activation: ``"silu"``, ``"gelu"``, ``"tanh"`` or (paper) ``"relu"``.
        pool: aggregation of all nodes and edges for the globals: ``"sum"`` (paper) or ``"mean"``, which does not grow
            with the graph.

    Raises:
        ValueError: if ``pool`` or the activation is not known.
    """

    def __init__(
        self,
        in_size: GraphSize,
        out_size: GraphSize,
        *,
        edge_hidden: Sequence[int] = (128, 128),
        node_hidden: Sequence[int] = (128, 128),
        global_hidden: Sequence[int] = (128, 128),
        activation: str = "silu",
        pool: Pool = "sum",
    ) -> None:
        super().__init__(aggr="sum", node_dim=-2)
        if pool not in get_args(Pool):
            raise ValueError(f"pool={pool!r} is not known; use one of {list(get_args(Pool))}.")
        self.pool: Pool = pool
        self.in_size, self.out_size = in_size, out_size
        g, n, e = in_size.globals_, in_size.nodes, in_size.edges
        edges, nodes = out_size.edges or e, out_size.nodes or n
        self.edge_mlp = _mlp(g + 2 * n + e, edge_hidden, out_size.edges, activation)
        self.node_mlp = _mlp(g + n + edges, node_hidden, out_size.nodes, activation)
        self.global_mlp = _mlp(g + nodes + edges, global_hidden, out_size.globals_, activation)

    def _set_jittable_templates(self, raise_on_error: bool = False) -> None:
        """Skip PyG's code generation for TorchScript, which leaves files in the temporary folder."""

    def __repr__(self) -> str:
        return nn.Module.__repr__(self)  # PyG's omits the layers

    def forward(self, graph: Graph) -> Graph:
        """Update edges ``[*B, E, F]``, then nodes ``[*B, N, F]``, then globals ``[*B, F]``."""
        nodes, edges, globals_, edge_index = graph.nodes, graph.edges, graph.globals_, graph.edge_index
        num_nodes = nodes.shape[-2]
        if self.edge_mlp is not None:
            edges = self.edge_updater(edge_index, nodes=nodes, edges=edges, globals_=globals_)
        if self.node_mlp is not None:
            received = self.propagate(edge_index, edges=edges, size=(num_nodes, num_nodes))
            nodes = self.node_mlp(torch.cat((_per_item(globals_, num_nodes), nodes, received), dim=-1))
        if self.global_mlp is not None:
            count = [max(x.shape[-2], 1) if self.pool == "mean" else 1 for x in (nodes, edges)]
            pooled = (x.sum(-2) / n for x, n in zip((nodes, edges), count, strict=True))
            globals_ = self.global_mlp(torch.cat((globals_, *pooled), dim=-1))
        return Graph(nodes, edges, globals_, edge_index)

    def edge_update(self, nodes_j: Tensor, nodes_i: Tensor, edges: Tensor, globals_: Tensor) -> Tensor:
        globals_ = _per_item(globals_, edges.shape[-2])
        assert self.edge_mlp is not None
        return self.edge_mlp(torch.cat((globals_, nodes_j, nodes_i, edges), dim=-1))

    def message(self, edges: Tensor) -> Tensor:
        return edges


def _mlp(in_features: int, hidden: Sequence[int], out_features: int, activation: str) -> MLP | None:
    if not out_features:
        return None
    return MLP(in_features, out_features, num_cells=list(hidden), activation_class=activation_class(activation))


def _per_item(globals_: Tensor, count: int) -> Tensor:
    return globals_.unsqueeze(-2).expand(*globals_.shape[:-1], count, globals_.shape[-1])
