"""Recurrent core: GRUs over nodes, edges and globals before the graph networks."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import Tensor, nn

from torchrl_gn.networks.core import Core, UnfoldedCore
from torchrl_gn.networks.foldable import change_of_core
from torchrl_gn.networks.folded_gn_core import FoldedGNCore
from torchrl_gn.networks.gn_core import GNCore
from torchrl_gn.networks.graph import Graph, GraphSize, graph_concat
from torchrl_gn.networks.incidence import Incidence


class RecurrentCore(Core):
    """Three GRUs, over nodes, edges and globals, before the graph networks (paper, "Forward models").

    A :class:`GNCore` reads the input graph with the hidden state concatenated. In the paper, one GN block reads the
    hidden state alone.

    Args:
        hidden_state: features of the hidden state's nodes, edges and globals (paper: 20 each).
        sizes: options of :class:`GNCore`.
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
        size, graph = GraphSize(*hidden_state), dynamic + static
        super().__init__(dynamic, hidden_size=size)
        self.nodes = nn.GRUCell(graph.nodes, size.nodes)
        self.edges = nn.GRUCell(graph.edges, size.edges)
        self.globals_ = nn.GRUCell(graph.globals_, size.globals_)
        self.core = GNCore(dynamic + size, static, out_nodes, **sizes)

    def update(self, dynamic: Graph, static: Graph, hidden: Graph) -> Graph:
        graph = graph_concat(dynamic, static)
        cells = zip((self.nodes, self.edges, self.globals_), graph.features, hidden.features, strict=True)
        return Graph(*[_apply_cell(*cell) for cell in cells], edge_index=dynamic.edge_index)

    def forward(self, graph: Graph) -> Graph:
        return self.core(graph)

    def fold(self, incidence: Incidence, static: Graph) -> FoldedGNCore | UnfoldedCore:
        """Fold the :class:`GNCore`, see :meth:`GNCore.fold`; the GRUs, which :meth:`update` runs, stay unfolded."""
        change = change_of_core(self, RecurrentCore)
        if change is None and not isinstance(self.core, Core):
            change = f"core is {type(self.core).__name__}"
        if change is not None:
            return UnfoldedCore(self, static, change)
        return self.core.fold(incidence, static)


def _apply_cell(cell: nn.GRUCell, features: Tensor, hidden: Tensor) -> Tensor:
    """Apply the cell to every item ``[*B, (I,) F]``."""
    if cell.hidden_size == 0:
        return hidden
    rows = math.prod(hidden.shape[:-1])  # 1 for the globals of a single graph
    flat = (each.reshape(rows, each.shape[-1]) for each in (features, hidden))
    return cell(*flat).view_as(hidden)
