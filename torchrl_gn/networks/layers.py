"""A folded network as a list of linear layers: data for engines that run it without torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

NODES, EDGES, FIRST = 0, 1, 2  # buffers: node inputs, edge inputs, output of the first layer


@dataclass(frozen=True)
class Gather:
    """Input rows of a layer, one for each of its items: row i is a sum of some items of a buffer."""

    source: int  # NODES, EDGES or FIRST + i for the output of layer i
    offsets: Tensor  # [I + 1] int64; row i sums items[offsets[i] : offsets[i + 1]]
    items: Tensor  # [offsets[-1]] int64

    @classmethod
    def sums(cls, source: int, matrix: Tensor) -> Gather:
        """Return the gather that computes ``matrix @ buffer``, for a matrix ``[I, J]`` of zeros and ones."""
        ones = matrix != 0
        counts = torch.cat((ones.new_zeros(1), ones.sum(1)))
        return cls(source, counts.cumsum(0), ones.nonzero()[:, 1])

    @classmethod
    def picks(cls, source: int, items: Tensor) -> Gather:
        """Return the gather whose row i is item ``items[i]``, for indices ``[I]``."""
        return cls(source, torch.arange(len(items) + 1, device=items.device), items)


@dataclass(frozen=True)
class LinearLayer:
    """``out[i] = activation(table[i] + sum_a added_a[i] + concat_k(inputs_k[i]) @ weight.T)`` for every item i."""

    inputs: tuple[Gather, ...]  # concatenated
    weight: Tensor  # [out, K], K the sum of the inputs' widths
    table: Tensor | None = None  # [I, out]; [I, B, out] with one table per sample
    added: tuple[Gather, ...] = ()  # from buffers of width out
    activation: str | None = None  # one of ACTIVATIONS

    @property
    def count(self) -> int:
        """Number of items I."""
        return len(self.inputs[0].offsets) - 1


@dataclass(frozen=True)
class LayerList:
    """A network of node inputs ``[N, F_n]`` and edge inputs ``[E, F_e]``.

    The last layer's output is the prediction: ``[P, F_out]``, or one item ``[1, P F_out]`` of an MLP.
    """

    nodes: tuple[int, int]  # N, F_n
    edges: tuple[int, int]  # E, F_e
    layers: tuple[LinearLayer, ...]


class LayerBuilder:
    """Builder of a layer list; its methods append layers and return the buffer of the output."""

    def __init__(self, activation: str) -> None:
        self.activation = activation
        self.layers: list[LinearLayer] = []

    def add(self, inputs: Sequence[Gather], weight: Tensor, *args, **options) -> int:
        """Append a layer; return the buffer of its output."""
        self.layers.append(LinearLayer(tuple(inputs), weight, *args, **options))
        return FIRST + len(self.layers) - 1

    def hidden(self, source: int, layers: Sequence[tuple[Tensor, Tensor]]) -> int:
        """Append hidden layers ``(weight, bias)`` for every item of a layer's output; return the last buffer."""
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
        """Append a layer that reads some items of one buffer; return the buffer of its output."""
        table = None if bias is None else bias.expand(len(items), -1)
        return self.add((Gather.picks(source, items),), weight, table, activation=activation)
