"""Recurrent core: GRUs that remember, before the graph networks."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import Tensor, nn

from torchrl_gn.networks.folded_gn_core import FoldedCore
from torchrl_gn.networks.gn_core import GNCore
from torchrl_gn.networks.graph import Graph, GraphSize, graph_concat
from torchrl_gn.networks.incidence import Incidence


class RecurrentCore(nn.Module):
    """Three GRUs, over nodes, edges and globals, before the graph networks (paper, "Forward models").

    What they remember joins the input graph of a :class:`GNCore`. Paper: one GN block on what the GRUs give alone,
    20 features of each; that would squeeze the present state through 20 numbers.

    Args:
        dynamic: features of the dynamic graph.
        static: features of the static graph, which does not change and is not remembered.
        out_nodes: features of every output node.
        hidden_state: features of the remembered nodes, edges and globals.
        **sizes: of :class:`GNCore`.
    """

    def __init__(
        self,
        dynamic: GraphSize,
        static: GraphSize,
        out_nodes: int,
        *,
        hidden_state: Sequence[int] = (20, 20, 20),
        **sizes,
    ) -> None:
        super().__init__()
        self.memory_size = GraphSize(*hidden_state)
        self.nodes = nn.GRUCell(dynamic.nodes + static.nodes, self.memory_size.nodes)
        self.edges = nn.GRUCell(dynamic.edges + static.edges, self.memory_size.edges)
        self.globals_ = nn.GRUCell(dynamic.globals_ + static.globals_, self.memory_size.globals_)
        self.core = GNCore(dynamic + self.memory_size + static, out_nodes, **sizes)

    def start(self, dynamic: Graph) -> Graph:
        """Memory of nothing, for a batch like that of a dynamic graph ``[*B, ...]``."""
        return dynamic.zeros(self.memory_size)

    def remember(self, dynamic: Graph, static: Graph, hidden_state: Graph) -> Graph:
        """Memory after one more dynamic graph."""
        graph = graph_concat(dynamic, static)
        return Graph(
            _each(self.nodes, graph.nodes, hidden_state.nodes),
            _each(self.edges, graph.edges, hidden_state.edges),
            _each(self.globals_, graph.globals_, hidden_state.globals_),
            dynamic.edge_index,
        )

    def forward(self, graph: Graph) -> Graph:
        """Dynamic, remembered and static features side by side in, ``out_nodes`` node features out."""
        return self.core(graph)

    def fold(self, size: GraphSize, incidence: Incidence, static: Graph) -> FoldedCore:
        """The graph networks with all that is constant folded, of dynamic and remembered features."""
        return self.core.fold(size + self.memory_size, incidence, static)


def _each(cell: nn.GRUCell, features: Tensor, hidden: Tensor) -> Tensor:
    """The cell for every item ``[*B, (I,) F]``."""
    if cell.hidden_size == 0:
        return hidden
    rows = math.prod(hidden.shape[:-1])  # one, of a single graph's globals
    flat = (each.reshape(rows, each.shape[-1]) for each in (features, hidden))
    return cell(*flat).view_as(hidden)
