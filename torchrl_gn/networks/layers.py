"""A folded network as a list of linear layers: data for engines that run it without torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

NODES, EDGES, FIRST = 0, 1, 2  # buffers: node inputs, edge inputs, output of the first layer


@dataclass(frozen=True)
class Gather:
    """One row for each item of a layer: the sum of some items of a buffer."""

    source: int  # NODES, EDGES or FIRST + i for the output of layer i
    offsets: Tensor  # [I + 1] int64; row i sums items[offsets[i] : offsets[i + 1]]
    items: Tensor  # [offsets[-1]] int64

    @classmethod
    def sums(cls, source: int, matrix: Tensor) -> Gather:
        """Rows of ``matrix @ buffer``, for a matrix ``[I, J]`` of zeros and ones."""
        ones = matrix != 0
        counts = torch.cat((ones.new_zeros(1), ones.sum(1)))
        return cls(source, counts.cumsum(0), ones.nonzero()[:, 1])

    @classmethod
    def picks(cls, source: int, items: Tensor) -> Gather:
        """One item for each row, ``[I]`` indices."""
        return cls(source, torch.arange(len(items) + 1, device=items.device), items)


@dataclass(frozen=True)
class LinearLayer:
    """``out[i] = activation(table[i] + sum_a added_a[i] + concat_k(inputs_k[i]) @ weight.T)`` for items i."""

    inputs: tuple[Gather, ...]  # side by side
    weight: Tensor  # [out, K], K the sum of the inputs' widths
    table: Tensor | None = None  # [I, out], or of each sample [I, B, out]
    added: tuple[Gather, ...] = ()  # from buffers of width out
    activation: str | None = None  # one of ACTIVATIONS

    @property
    def count(self) -> int:
        """Number of items I."""
        return len(self.inputs[0].offsets) - 1


@dataclass(frozen=True)
class LayerList:
    """A network of node inputs ``[N, F_n]`` and edge inputs ``[E, F_e]``; the last layer's output is the prediction.

    That is ``[P, F_out]``, of an MLP in one item ``[1, P F_out]``.
    """

    nodes: tuple[int, int]  # N, F_n
    edges: tuple[int, int]  # E, F_e
    layers: tuple[LinearLayer, ...]


class LayerBuilder:
    """Collects layers in order."""

    def __init__(self, activation: str) -> None:
        self.activation = activation
        self.layers: list[LinearLayer] = []

    def add(self, inputs: Sequence[Gather], weight: Tensor, *args, **options) -> int:
        """Append a layer; its output's buffer."""
        self.layers.append(LinearLayer(tuple(inputs), weight, *args, **options))
        return FIRST + len(self.layers) - 1

    def hidden(self, source: int, layers: Sequence[tuple[Tensor, Tensor]]) -> int:
        """Append hidden layers, weights and biases, after a buffer with as many items; the last one's buffer."""
        for weight, bias in layers:
            count = self.layers[source - FIRST].count
            source = self.linear(source, torch.arange(count, device=weight.device), weight, bias, self.activation)
        return source

    def linear(
        self,
        source: int,
        items: Tensor,
        weight: Tensor,
        bias: Tensor | None = None,
        activation: str | None = None,
    ) -> int:
        """Append a layer of some items of one buffer."""
        table = None if bias is None else bias.expand(len(items), -1)
        return self.add((Gather.picks(source, items),), weight, table, activation=activation)
