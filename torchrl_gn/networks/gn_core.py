"""The forward model's core: two graph networks with a graph skip connection."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torchrl_gn.checks import check_count
from torchrl_gn.networks.core import Core, UnfoldedCore, layer_sizes
from torchrl_gn.networks.fold_gn_core import fold_gn_core
from torchrl_gn.networks.foldable import change_of_block, change_of_core
from torchrl_gn.networks.folded_gn_core import FoldedGNCore
from torchrl_gn.networks.gn_block import GNBlock, Pool
from torchrl_gn.networks.graph import Graph, GraphSize, graph_concat
from torchrl_gn.networks.incidence import Incidence


class GNCore(Core):
    r"""Two GN blocks, :math:`G^* = GN_2(concat(G, GN_1(G)))` (paper, "Forward models").

    The globals of the first block let all nodes and edges communicate. The second block has no global update: only
    nodes are predicted.

    Args:
        hidden: width of the hidden layers of every MLP, or their sizes.
        layers: hidden layers of every MLP, if ``hidden`` is one width.
        latent: features of the graph between the blocks, and edge features inside the second; default: the width of
            the last hidden layer.
        edge_hidden: hidden sizes of the edge MLPs; default: those of ``hidden``.
        node_hidden: hidden sizes of the node MLPs, likewise.
        global_hidden: hidden sizes of the global MLP, likewise.
        activation: ``"silu"``, ``"gelu"``, ``"tanh"`` or (paper) ``"relu"``.
        pool: see :class:`GNBlock`.

    Raises:
        ValueError: if an MLP has no hidden layer, a size is not a whole number of at least 1, or ``activation`` or
            ``pool`` is not known.
    """

    def __init__(
        self,
        dynamic: GraphSize,
        static: GraphSize,
        out_nodes: int,
        *,
        hidden: int | Sequence[int] = 128,
        layers: int = 2,
        latent: int | None = None,
        edge_hidden: Sequence[int] | None = None,
        node_hidden: Sequence[int] | None = None,
        global_hidden: Sequence[int] | None = None,
        activation: str = "silu",
        pool: Pool = "sum",
    ) -> None:
        super().__init__(dynamic)
        self.activation = activation
        usual = layer_sizes(hidden, layers)
        edge, node, last = (usual if each is None else each for each in (edge_hidden, node_hidden, global_hidden))
        if not (edge and node and last):
            raise ValueError(
                f"Every MLP of the core needs a hidden layer, got edges {edge}, nodes {node}, globals {last}."
            )
        latent = usual[-1] if latent is None else latent
        check_count("latent", latent, 1)
        graph, between = dynamic + static, GraphSize(latent, latent, latent)
        sizes: dict[str, Any] = {"edge_hidden": edge, "node_hidden": node, "activation": activation}
        self.first = GNBlock(graph, between, global_hidden=last, pool=pool, **sizes)
        self.second = GNBlock(graph + between, GraphSize(out_nodes, latent, 0), **sizes)

    def forward(self, graph: Graph) -> Graph:
        return self.second(graph_concat(graph, self.first(graph)))

    def fold(self, incidence: Incidence, static: Graph) -> FoldedGNCore | UnfoldedCore:
        """Fold the core; return an :class:`UnfoldedCore`, which passes messages, if the core was changed."""
        if (change := self._change()) is not None:
            return UnfoldedCore(self, static, change)
        return fold_gn_core(self, self.dynamic, incidence, static)

    def _change(self) -> str | None:
        """Describe the change that prevents folding; None without one."""
        if (change := change_of_core(self, GNCore)) is not None:
            return change
        if (change := change_of_block(self.first, ("edge_mlp", "node_mlp", "global_mlp"), self.activation)) is not None:
            return f"first{change}"
        if (change := change_of_block(self.second, ("edge_mlp", "node_mlp"), self.activation)) is not None:
            return f"second{change}"
        return None
