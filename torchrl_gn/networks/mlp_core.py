"""The graph networks' rival: one MLP over the flattened graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.modules import MLP

from torchrl_gn.networks.folded_gn_core import Columns
from torchrl_gn.networks.graph import Graph, GraphSize
from torchrl_gn.networks.incidence import Incidence
from torchrl_gn.networks.linear import ACTIVATIONS, activation_class


class MLPCore(nn.Module):
    """One MLP in place of the graph networks (paper, SM "MLP baseline architectures").

    All features of all nodes, edges and globals side by side in, the features of all nodes
    out: it is tied to graphs of one size, and has to learn each body's motion apart.

    Args:
        in_size: features of the input graph.
        out_nodes: features of every output node.
        items: numbers of nodes and edges of the graphs.
        hidden: hidden sizes.
        activation: between the layers.

    Raises:
        ValueError: if there is no hidden layer, or the activation is not known.
    """

    def __init__(
        self,
        in_size: GraphSize,
        out_nodes: int,
        *,
        items: tuple[int, int],
        hidden: Sequence[int],
        activation: str = "relu",
    ) -> None:
        super().__init__()
        if not hidden:
            raise ValueError("The MLP needs a hidden layer.")
        self.in_size, self.out_nodes, self.items, self.activation = in_size, out_nodes, items, activation
        inputs = items[0] * in_size.nodes + items[1] * in_size.edges + in_size.globals_
        self.mlp = MLP(
            inputs, items[0] * out_nodes, num_cells=list(hidden), activation_class=activation_class(activation)
        )

    def forward(self, graph: Graph) -> Graph:
        """Graph with ``in_size`` features in, graph with ``out_nodes`` node features out."""
        out = self.mlp(torch.cat(_flat(graph), dim=-1))
        empty = out[..., :0]
        return Graph(out.unflatten(-1, (self.items[0], -1)), empty.unsqueeze(-2), empty, graph.edge_index)

    def fold(self, size: GraphSize, incidence: Incidence, static: Graph) -> FoldedMLP:
        """Everything constant in a table; arguments as of :func:`~torchrl_gn.networks.folded_gn_core.fold_core`."""
        first, *hidden, last = (layer for layer in self.mlp if isinstance(layer, nn.Linear))
        nodes, edges = self.items
        here, every = (size.nodes, size.edges), (self.in_size.nodes, self.in_size.edges)
        device = first.weight.device
        dynamic, constant, start = [], [], 0
        for count, own, full in zip((nodes, edges), here, every, strict=True):
            columns = start + torch.arange(count * full, device=device).view(count, full)
            dynamic.append(columns[:, :own].flatten())
            constant.append(columns[:, own:].flatten())
            start += count * full
        columns = torch.arange(start, start + self.in_size.globals_, device=device)
        dynamic.append(columns[: size.globals_])
        constant.append(columns[size.globals_ :])
        table = F.linear(torch.cat(_broadcast(_flat(static)), -1), first.weight[:, torch.cat(constant)], first.bias)
        predicted = incidence.predicted
        rows = (predicted[:, None] * self.out_nodes + torch.arange(self.out_nodes, device=device)).flatten()
        return FoldedMLP(
            weights=tuple(first.weight[:, index] for index in dynamic),
            table=table,
            hidden=tuple((layer.weight, layer.bias) for layer in hidden),
            out=(
                last.weight[rows].unflatten(0, (-1, self.out_nodes)),
                last.bias[rows].unflatten(0, (-1, self.out_nodes)),
            ),
            predicted=predicted,
            items=self.items,
            activation=self.activation,
        )


@dataclass(frozen=True)
class FoldedMLP:
    """An :class:`MLPCore` for one scene, ready to be multiplied.

    Attributes:
        weights: ``[h, N F_n]``, ``[h, E F_e]`` and ``[h, F_g]`` for the dynamic nodes, edges and globals.
        table: ``[h]`` or ``[*B, h]``, biases and static features.
        hidden: weight and bias of each further hidden layer.
        out: weight ``[P, F_out, h]`` and bias ``[P, F_out]``.
        predicted: ``[P]`` nodes that are predicted.
        items: numbers of nodes and edges.
        activation: after every hidden layer.
    """

    weights: tuple[Tensor, ...]
    table: Tensor
    hidden: tuple[tuple[Tensor, Tensor], ...]
    out: tuple[Tensor, Tensor]
    predicted: Tensor
    items: tuple[int, int]
    activation: str

    def predict(self, dynamic: Graph) -> Tensor:
        """Output nodes ``[*B, N, F_out]`` of a normalised dynamic graph ``[*B, ...]``, zero if not predicted."""
        act = ACTIVATIONS[self.activation]()
        hidden = act(F.linear(torch.cat(_flat(dynamic), -1), torch.cat(self.weights, 1)) + self.table)
        for weight, bias in self.hidden:
            hidden = act(F.linear(hidden, weight, bias))
        weight, bias = self.out
        out = F.linear(hidden, weight.flatten(0, 1), bias.flatten()).unflatten(-1, bias.shape)
        full = out.new_zeros(*out.shape[:-2], self.items[0], out.shape[-1])
        return full.index_copy(-2, self.predicted, out)

    def reduced(self, nodes: Columns, edges: Columns, out: Columns, shift: Tensor) -> FoldedMLP:
        """This MLP with fewer and rescaled features, as ``FoldedCore.reduced``."""
        parts = list(self.weights)
        for index, (columns, count) in enumerate(zip((nodes, edges), self.items, strict=True)):
            kept, factor = columns
            parts[index] = (parts[index].unflatten(1, (count, -1))[:, :, kept] * factor).flatten(1)
        weight, bias = self.out
        rows, factor = out
        changed = weight[:, rows] * factor[:, None], bias[:, rows] * factor + shift
        return replace(self, weights=tuple(parts), out=changed)


def _flat(graph: Graph) -> tuple[Tensor, Tensor, Tensor]:
    return graph.nodes.flatten(-2), graph.edges.flatten(-2), graph.globals_


def _broadcast(parts: Sequence[Tensor]) -> list[Tensor]:
    batch = torch.broadcast_shapes(*(part.shape[:-1] for part in parts))
    return [part.expand(*batch, part.shape[-1]) for part in parts]
