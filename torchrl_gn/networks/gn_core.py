"""The forward model's core: two graph networks with a graph skip connection."""

from __future__ import annotations

from collections.abc import Sequence

from torch import nn

from torchrl_gn.networks.folded_gn_core import FoldedCore, fold_core
from torchrl_gn.networks.gn_block import GNBlock, Pool
from torchrl_gn.networks.graph import Graph, GraphSize, graph_concat
from torchrl_gn.networks.incidence import Incidence


class GNCore(nn.Module):
    r"""Two GN blocks, :math:`G^* = GN_2(concat(G, GN_1(G)))` (paper, "Forward models").

    The first block's globals let all nodes and edges communicate.

    Args:
        in_size: features of the input graph.
        out_nodes: features of every output node. Only nodes are predicted, so the second
            block has no global update.
        latent: edge, node and global features of the graph between the blocks, and edge
            features inside the second.
        edge_hidden: hidden sizes of both edge MLPs.
        node_hidden: hidden sizes of both node MLPs.
        global_hidden: hidden sizes of the global MLP.
        activation: between the layers of all MLPs.
        pool: as of :class:`GNBlock`.

    Raises:
        ValueError: if an MLP has no hidden layer, or the activation or ``pool`` is not known.
    """

    def __init__(
        self,
        in_size: GraphSize,
        out_nodes: int,
        *,
        latent: int = 128,
        edge_hidden: Sequence[int] = (128, 128),
        node_hidden: Sequence[int] = (128, 128),
        global_hidden: Sequence[int] = (128, 128),
        activation: str = "relu",
        pool: Pool = "sum",
    ) -> None:
        super().__init__()
        self.activation = activation
        if not (edge_hidden and node_hidden and global_hidden):
            raise ValueError(
                "Every MLP of the core needs a hidden layer, got"
                f" edge_hidden={edge_hidden}, node_hidden={node_hidden}, global_hidden={global_hidden}."
            )
        between = GraphSize(latent, latent, latent)
        self.first = GNBlock(
            in_size,
            between,
            edge_hidden=edge_hidden,
            node_hidden=node_hidden,
            global_hidden=global_hidden,
            activation=activation,
            pool=pool,
        )
        self.second = GNBlock(
            in_size + between,
            GraphSize(out_nodes, latent, 0),
            edge_hidden=edge_hidden,
            node_hidden=node_hidden,
            activation=activation,
        )

    def forward(self, graph: Graph) -> Graph:
        """Graph with ``in_size`` features in, graph with ``out_nodes`` node features out."""
        return self.second(graph_concat(graph, self.first(graph)))

    def fold(self, size: GraphSize, incidence: Incidence, static: Graph) -> FoldedCore:
        """The same function for graphs of one topology with all that is constant folded, see :func:`fold_core`."""
        return fold_core(self, size, incidence, static)
