"""The baseline of the graph networks: one MLP over the flattened graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.modules import MLP

from torchrl_gn.networks.core import Columns, Core, UnfoldedCore, layer_sizes
from torchrl_gn.networks.foldable import change_of_core, change_of_mlp
from torchrl_gn.networks.graph import Graph, GraphSize
from torchrl_gn.networks.incidence import Incidence
from torchrl_gn.networks.layers import EDGES, NODES, Gather, LayerBuilder, LayerList
from torchrl_gn.networks.linear import ACTIVATIONS, activation_class


class MLPCore(Core):
    """One MLP in place of the graph networks (paper, SM "MLP baseline architectures").

    Reads the concatenated features of all nodes, edges and globals and outputs the features of all nodes, so it is tied
    to graphs of one size.

    Args:
        counts: numbers of nodes and edges of the graphs.
        hidden: width of the hidden layers, or their sizes.
        layers: number of hidden layers, if ``hidden`` is one width.

    Raises:
        ValueError: if ``counts`` is missing, there is no hidden layer, or the activation is not known.
    """

    fixed_size = True

    def __init__(
        self,
        dynamic: GraphSize,
        static: GraphSize,
        out_nodes: int,
        *,
        counts: Sequence[int] | None = None,
        hidden: int | Sequence[int] = 256,
        layers: int = 5,
        activation: str = "silu",
    ) -> None:
        super().__init__(dynamic)
        if counts is None:
            raise ValueError("An MLP core needs counts, the numbers of nodes and edges of its graphs; see for_scene.")
        cells = layer_sizes(hidden, layers)
        if not cells:
            raise ValueError("The MLP needs a hidden layer.")
        nodes, edges = counts
        self.counts = nodes, edges
        self.graph_size, self.out_nodes, self.activation = dynamic + static, out_nodes, activation
        inputs = nodes * self.graph_size.nodes + edges * self.graph_size.edges + self.graph_size.globals_
        self.mlp = MLP(inputs, nodes * out_nodes, num_cells=cells, activation_class=activation_class(activation))

    def forward(self, graph: Graph) -> Graph:
        out = self.mlp(torch.cat(_flat(graph), dim=-1))
        empty = out[..., :0]
        assert self.counts is not None
        return Graph(out.unflatten(-1, (self.counts[0], -1)), empty.unsqueeze(-2), empty, graph.edge_index)

    def fold(self, incidence: Incidence, static: Graph) -> FoldedMLP | UnfoldedCore:
        """Fold all constants into a table; return an :class:`UnfoldedCore` if the core was changed."""
        if (change := change_of_core(self, MLPCore)) is not None:
            return UnfoldedCore(self, static, change)
        if (change := change_of_mlp(self.mlp, self.activation)) is not None:
            return UnfoldedCore(self, static, f"mlp{change}")
        assert self.counts is not None
        first, *hidden, last = (layer for layer in self.mlp if isinstance(layer, nn.Linear))
        counts, sizes = (*self.counts, 1), (astuple(self.dynamic), astuple(self.graph_size))
        device = first.weight.device
        dynamic, constant, start = [], [], 0
        for count, own, full in zip(counts, *sizes, strict=True):
            columns = start + torch.arange(count * full, device=device).view(count, full)
            dynamic.append(columns[:, :own].flatten())
            constant.append(columns[:, own:].flatten())
            start += count * full
        table = F.linear(torch.cat(_broadcast(_flat(static)), -1), first.weight[:, torch.cat(constant)], first.bias)
        predicted = incidence.predicted
        rows = (predicted[:, None] * self.out_nodes + torch.arange(self.out_nodes, device=device)).flatten()
        weight, bias = (each[rows].unflatten(0, (-1, self.out_nodes)) for each in (last.weight, last.bias))
        return FoldedMLP(
            weights=tuple(first.weight[:, index] for index in dynamic),
            table=table,
            hidden=tuple((layer.weight, layer.bias) for layer in hidden),
            out=(weight, bias),
            predicted=predicted,
            counts=self.counts,
            activation=self.activation,
        )


@dataclass(frozen=True)
class FoldedMLP:
    """The folded weights of an :class:`MLPCore` for one scene."""

    weights: tuple[Tensor, ...]  # [h, N F_n], [h, E F_e] and [h, F_g] for the dynamic nodes, edges and globals
    table: Tensor  # [h] or [*B, h], biases and static features
    hidden: tuple[tuple[Tensor, Tensor], ...]  # weight and bias of each further hidden layer
    out: tuple[Tensor, Tensor]  # weight [P, F_out, h] and bias [P, F_out]
    predicted: Tensor  # [P] predicted nodes
    counts: tuple[int, int]  # numbers of nodes and edges
    activation: str  # after every hidden layer

    def predict(self, dynamic: Graph) -> Tensor:
        """Return nodes ``[*B, N, F_out]``, zero if not predicted, for a normalised dynamic graph ``[*B, ...]``."""
        act = ACTIVATIONS[self.activation]()
        hidden = act(F.linear(torch.cat(_flat(dynamic), -1), torch.cat(self.weights, 1)) + self.table)
        for weight, bias in self.hidden:
            hidden = act(F.linear(hidden, weight, bias))
        weight, bias = self.out
        out = F.linear(hidden, weight.flatten(0, 1), bias.flatten()).unflatten(-1, bias.shape)
        full = out.new_zeros(*out.shape[:-2], self.counts[0], out.shape[-1])
        return full.index_copy(-2, self.predicted, out)

    def layers(self) -> LayerList | None:
        """Return the network as a list of layers; None with dynamic globals."""
        if self.weights[2].shape[1]:
            return None
        device = self.table.device
        items = [torch.tensor([i], device=device) for i in range(max(self.counts))]
        sizes = zip((NODES, EDGES), self.counts, strict=True)
        inputs = [Gather.picks(source, item) for source, count in sizes for item in items[:count]]
        builder = LayerBuilder(self.activation)
        weight, table = torch.cat(self.weights, 1), self.table.reshape(1, -1, self.table.shape[-1]).squeeze(1)
        first = builder.add(inputs, weight, table, activation=self.activation)
        weight, bias = self.out
        builder.linear(builder.hidden(first, self.hidden), items[0], weight.flatten(0, 1), bias.flatten())
        (nodes, edges), widths = self.counts, [each.shape[1] for each in self.weights]
        buffers = (nodes, widths[0] // nodes), (edges, widths[1] // max(edges, 1))
        return LayerList(*buffers, tuple(builder.layers))

    def reduced(self, nodes: Columns, edges: Columns, out: Columns, shift: Tensor) -> FoldedMLP:
        """Return this MLP with fewer, rescaled features; see :class:`~torchrl_gn.networks.core.ReducibleCore`."""
        parts = list(self.weights)
        for index, (columns, count) in enumerate(zip((nodes, edges), self.counts, strict=True)):
            kept, factor = columns
            parts[index] = (parts[index].unflatten(1, (count, -1))[:, :, kept] * factor.to(parts[index].dtype)).flatten(
                1
            )
        weight, bias = self.out
        rows, factor, shift = out[0], out[1].to(weight.dtype), shift.to(weight.dtype)
        changed = weight[:, rows] * factor[:, None], bias[:, rows] * factor + shift
        return replace(self, weights=tuple(parts), out=changed)


def _flat(graph: Graph) -> tuple[Tensor, Tensor, Tensor]:
    return graph.nodes.flatten(-2), graph.edges.flatten(-2), graph.globals_


def _broadcast(parts: Sequence[Tensor]) -> list[Tensor]:
    batch = torch.broadcast_shapes(*(part.shape[:-1] for part in parts))
    return [part.expand(*batch, part.shape[-1]) for part in parts]
