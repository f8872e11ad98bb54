"""Cores of the paper's ablation study: two GN blocks without one of their parts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

from torchrl_gn.networks import CORES, Core, GNBlock, Graph, GraphSize, graph_concat
from torchrl_gn.networks.core import layer_sizes

Ablation = Literal["none", "interaction_network", "no_edge_update", "no_node_update", "no_global_update"]


class AblatedCore(Core):
    """Two GN blocks without one of their parts (paper, SM Figure "Ablation study of the architecture").

    The core is evaluated by message passing; nothing is folded.

    Args:
        dynamic: features of the dynamic graph.
        static: features of the static graph.
        out_nodes: features of every output node.
        ablation: ``"interaction_network"`` has one GN block in place of two; with ``"no_<part>_update"`` the first
            block leaves that part of the graph as it is; ``"none"`` keeps all.
        skip: whether the second block also reads the input graph.
        hidden: width of the hidden layers of every MLP, or their sizes.
        layers: hidden layers of every MLP, if ``hidden`` is one width.
        latent: features of the parts that the first block updates, and of edges inside the last block; default: the
            width of the last hidden layer.
        activation: activation between the layers of all MLPs.
        **sizes: ``edge_hidden``, ``node_hidden`` and ``global_hidden`` of :class:`~torchrl_gn.networks.GNBlock`.

    Raises:
        ValueError: if the ablation or the activation is not known.
    """

    def __init__(
        self,
        dynamic: GraphSize,
        static: GraphSize,
        out_nodes: int,
        *,
        ablation: Ablation = "none",
        skip: bool = True,
        hidden: int | Sequence[int] = 128,
        layers: int = 2,
        latent: int | None = None,
        activation: str = "silu",
        **sizes: Any,
    ) -> None:
        super().__init__(dynamic)
        if ablation not in get_args(Ablation):
            raise ValueError(f"ablation={ablation!r} is not known; use one of {list(get_args(Ablation))}.")
        self.ablation, self.skip = ablation, skip
        usual = layer_sizes(hidden, layers)
        latent = usual[-1] if latent is None else latent
        options: dict[str, Any] = {f"{part}_hidden": usual for part in ("edge", "node", "global")}
        options |= {"activation": activation, **sizes}
        graph = size = dynamic + static
        self.first: GNBlock | None = None
        if ablation != "interaction_network":
            updated = (0 if ablation == f"no_{part}_update" else latent for part in ("node", "edge", "global"))
            between = GraphSize(*updated)
            self.first = GNBlock(graph, between, **options)
            size = GraphSize(
                between.nodes or graph.nodes, between.edges or graph.edges, between.globals_ or graph.globals_
            )
            size = size + graph if skip else size
        self.last = GNBlock(size, GraphSize(out_nodes, latent, 0), **options)

    def forward(self, graph: Graph) -> Graph:
        """Map a graph with dynamic and static features to a graph with ``out_nodes`` node features."""
        if self.first is None:
            return self.last(graph)
        between = self.first(graph)
        return self.last(graph_concat(graph, between) if self.skip else between)


CORES["ablated"] = AblatedCore
