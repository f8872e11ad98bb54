"""The cores of the paper's ablation study: what the two graph networks are without one of their parts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from torch import Tensor, nn

from torchrl_gn.networks.gn_block import GNBlock
from torchrl_gn.networks.graph import Graph, GraphSize, graph_concat
from torchrl_gn.networks.incidence import Incidence

Ablation = Literal["none", "interaction_network", "no_edge_update", "no_node_update", "no_global_update"]


class AblatedCore(nn.Module):
    """Graph networks without a part (paper, SM Figure "Ablation study of the architecture").

    For the study only: evaluated as the paper writes it, not folded, and not specialised.

    Args:
        in_size: features of the input graph.
        out_nodes: features of every output node.
        ablation: ``"interaction_network"`` is one graph network in place of two; ``"no_<part>_update"`` lets the
            first one pass that part of the graph through; ``"none"`` keeps all.
        skip: whether the second graph network also reads the input graph.
        latent: features of what the first graph network updates, and edge features inside the last.
        activation: between the layers of all MLPs.
        **hidden: hidden sizes ``edge_hidden``, ``node_hidden`` and ``global_hidden``, as of
            :class:`~torchrl_gn.networks.GNBlock`.

    Raises:
        ValueError: if the ablation or the activation is not known.
    """

    def __init__(
        self,
        in_size: GraphSize,
        out_nodes: int,
        *,
        ablation: Ablation = "none",
        skip: bool = True,
        latent: int = 128,
        activation: str = "relu",
        **hidden,
    ) -> None:
        super().__init__()
        if ablation not in get_args(Ablation):
            raise ValueError(f"ablation={ablation!r} is not known; use one of {list(get_args(Ablation))}.")
        self.ablation, self.skip = ablation, skip
        self.first: GNBlock | None = None
        size = in_size
        if ablation != "interaction_network":
            updated = {part: 0 if ablation == f"no_{part}_update" else latent for part in ("node", "edge", "global")}
            between = GraphSize(updated["node"], updated["edge"], updated["global"])
            self.first = GNBlock(in_size, between, activation=activation, **hidden)
            size = GraphSize(
                between.nodes or in_size.nodes, between.edges or in_size.edges, between.globals_ or in_size.globals_
            )
            size = size + in_size if skip else size
        self.last = GNBlock(size, GraphSize(out_nodes, latent, 0), activation=activation, **hidden)

    def forward(self, graph: Graph) -> Graph:
        """Graph with ``in_size`` features in, graph with ``out_nodes`` node features out."""
        if self.first is None:
            return self.last(graph)
        between = self.first(graph)
        return self.last(graph_concat(graph, between) if self.skip else between)

    def fold(self, size: GraphSize, incidence: Incidence, static: Graph) -> UnfoldedCore:
        """The core with its static graph; nothing is folded."""
        return UnfoldedCore(self, static)


@dataclass(frozen=True)
class UnfoldedCore:
    """An :class:`AblatedCore` for one scene.

    Attributes:
        core: the core itself.
        static: normalised static graph.
    """

    core: AblatedCore
    static: Graph

    def predict(self, dynamic: Graph) -> Tensor:
        """Output nodes ``[*B, N, F_out]`` of a normalised dynamic graph ``[*B, ...]``."""
        return self.core(graph_concat(dynamic, self.static)).nodes
