"""A layer list with its weights and tables packed in the layout that the native executor reads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from torchrl_gn.networks.folded_gn_core import items_first
from torchrl_gn.networks.graph import Graph
from torchrl_gn.networks.incidence import Rows
from torchrl_gn.networks.layers import Gather, LayerList
from torchrl_gn.networks.linear import ACTIVATIONS

PANEL = 16  # columns of a panel


class _Gather(NamedTuple):
    source: int  # buffer
    items: Tensor  # [J]
    rows: Tensor | None  # [J] row that each item is added to; None: item i is row i
    count: int  # number of rows

    def __call__(self, buffers: Sequence[Tensor]) -> Tensor:
        """Gather rows ``[I, B, F]``."""
        buffer = buffers[self.source]
        items = buffer[self.items]
        if self.rows is None:
            return items
        return buffer.new_zeros(self.count, *buffer.shape[1:]).index_add(0, self.rows, items)

    def on(self, device: torch.device) -> _Gather:
        """Return the gather with its indices on a device."""
        return self._replace(items=self.items.to(device), rows=None if self.rows is None else self.rows.to(device))


class _Layer(NamedTuple):
    inputs: tuple[_Gather, ...]
    added: tuple[_Gather, ...]
    weight: tuple[int, int]  # rows and columns
    table: int | None  # rows of the table; None without one
    sampled: bool  # each sample has a table of its own
    activation: str | None


class LayerShapes:
    """A layer list without the values of its weights and tables; must not be changed."""

    def __init__(self, layers: LayerList) -> None:
        def gathers(given: Sequence[Gather]) -> tuple[_Gather, ...]:
            packed_gathers = []
            for gather in given:
                lengths = gather.offsets.diff().cpu()
                alone = bool((lengths == 1).all())
                rows = None if alone else torch.arange(len(lengths), device="cpu").repeat_interleave(lengths)
                packed_gathers.append(_Gather(gather.source, gather.items.cpu(), rows, len(lengths)))
            return tuple(packed_gathers)

        self.num_nodes = layers.nodes[0]
        self.layers = tuple(
            _Layer(
                gathers(layer.inputs),
                gathers(layer.added),
                (layer.weight.shape[0], layer.weight.shape[1]),
                None if layer.table is None else len(layer.table),
                layer.table is not None and layer.table.ndim == 3,
                layer.activation,
            )
            for layer in layers.layers
        )

        self._elsewhere: dict[torch.device, tuple[_Layer, ...]] = {}

    def on(self, device: torch.device) -> tuple[_Layer, ...]:
        """Return the layers with their indices on a device; copy them there once."""
        if device.type == "cpu":
            return self.layers
        if device not in self._elsewhere:
            self._elsewhere[device] = tuple(
                layer._replace(
                    inputs=tuple(gather.on(device) for gather in layer.inputs),
                    added=tuple(gather.on(device) for gather in layer.added),
                )
                for layer in self.layers
            )
        return self._elsewhere[device]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_elsewhere": {}}

    @property
    def weights(self) -> list[int]:
        """Rows and columns of every layer's weight, as one flat list."""
        return [size for layer in self.layers for size in layer.weight]

    @property
    def tables(self) -> list[int]:
        """Rows and columns of every shared table, as one flat list."""
        shared = [layer for layer in self.layers if layer.table is not None and not layer.sampled]
        return [size for layer in shared for size in (layer.table, layer.weight[0]) if size is not None]


@dataclass(frozen=True)
class PackedLayers:
    """A folded core for one scene, packed from a :class:`~torchrl_gn.networks.layers.LayerList`."""

    shapes: LayerShapes
    predicted: Rows  # predicted nodes
    # Panels [out / 16, K, 16] of every layer's weight, then of its transpose; bfloat16: pairs of columns.
    weights: Tensor
    tables: Tensor  # every shared table, its rows padded to whole panels
    numbers: Tensor  # [1 or B, P] float64 numbers of the model and of samples that the state maths reads
    sample_tables: Tensor | None = None  # every per-sample table, [I, B, out padded to 16]

    def predict(self, dynamic: Graph) -> Tensor:
        """Return nodes ``[*B, N, F_out]`` for a normalised dynamic graph ``[*B, ...]``, by torch operations."""
        batch, dtype = dynamic.nodes.shape[:-2], dynamic.nodes.dtype
        buffers = [items_first(dynamic.nodes), items_first(dynamic.edges)]
        layers = self.shapes.on(dynamic.nodes.device)
        for layer, weight, table in zip(layers, self.plain_weights(), self._plain_tables(), strict=True):
            out = F.linear(torch.cat([gather(buffers) for gather in layer.inputs], -1), weight.to(dtype))
            for gather in layer.added:
                out = out + gather(buffers)
            out = out if table is None else out + table.to(dtype)
            buffers.append(out if layer.activation is None else ACTIVATIONS[layer.activation]()(out))
        out, count = buffers[-1], self.shapes.num_nodes
        nodes = torch.arange(count, device=out.device)[self.predicted]
        width = out.shape[0] * out.shape[2] // max(len(nodes), 1)  # the one item of an MLP holds all nodes
        out = out.transpose(0, 1).reshape(out.shape[1], len(nodes), width)
        full = out.new_zeros(out.shape[0], count, out.shape[-1]).index_copy(1, nodes, out)
        return full.reshape(*batch, *full.shape[1:])

    def plain_weights(self) -> Iterator[Tensor]:
        """Yield every layer's weight ``[out, K]``."""
        offset, pairs = 0, 2 if self.weights.dtype == torch.bfloat16 else 1
        for layer in self.shapes.layers:
            rows, columns = layer.weight
            depth, across = (-(-size // pairs) for size in (columns, rows))  # in pairs
            size = _panels(rows) * depth * PANEL * pairs
            part = self.weights[offset : offset + size].view(_panels(rows), depth, PANEL, pairs)
            yield part.permute(0, 2, 1, 3).reshape(_panels(rows) * PANEL, depth * pairs)[:rows, :columns]
            offset += size + _panels(columns) * across * PANEL * pairs

    def _plain_tables(self) -> Iterator[Tensor | None]:
        """Yield every layer's table ``[I, 1 or B, out]``, None for a layer without one."""
        shared, own = 0, 0
        every = sum(_panels(each.weight[0]) * PANEL * (each.table or 0) for each in self.shapes.layers if each.sampled)
        batch = self.sample_tables.numel() // every if self.sample_tables is not None and every else 1
        for layer in self.shapes.layers:
            if layer.table is None:
                yield None
                continue
            width, columns = _panels(layer.weight[0]) * PANEL, layer.weight[0]
            if not layer.sampled:
                size = layer.table * width
                yield self.tables[shared : shared + size].view(layer.table, 1, width)[..., :columns]
                shared += size
            else:
                assert self.sample_tables is not None
                size = layer.table * batch * width
                yield self.sample_tables[own : own + size].view(layer.table, batch, width)[..., :columns]
                own += size


def pack_pairs(weights: Sequence[Tensor]) -> Tensor:
    """Pack weights and their transposes as bfloat16 panels of column pairs; pad an odd last column with zeros."""
    parts = []
    for weight in weights:
        for matrix in (weight, weight.T):
            rows, columns = matrix.shape
            padded = F.pad(matrix.to(torch.bfloat16), (0, columns % 2, 0, -rows % PANEL))
            pairs = padded.shape[1] // 2  # not -1: a layer without inputs, or its transpose, has no elements
            parts.append(padded.view(_panels(rows), PANEL, pairs, 2).permute(0, 2, 1, 3).flatten())
    return torch.cat(parts)


def pack_sample_tables(layers: LayerList, dtype: torch.dtype) -> Tensor | None:
    """Pack the per-sample tables ``[I, B, out]``, padded to whole panels; return None without any."""
    tables = [layer.table for layer in layers.layers if layer.table is not None and layer.table.ndim == 3]
    padded = [F.pad(table.to(dtype), (0, -table.shape[-1] % PANEL)).flatten() for table in tables]
    return torch.cat(padded) if padded else None


def _panels(size: int) -> int:
    return -(-size // PANEL)
