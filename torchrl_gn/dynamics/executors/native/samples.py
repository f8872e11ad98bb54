"""Physical parameters that samples bring: which of them the state maths reads as inputs, and their values."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchrl_gn.dynamics.executors.native.expressions import Expressions
from torchrl_gn.dynamics.executors.native.trace import Array
from torchrl_gn.networks.layers import LayerList
from torchrl_gn.scenes.physical_parameters import PhysicalParameters

_DIMS = (2, 2, 1, 2, 1, 1, 2, 2, 3, 2)  # of each physical parameter without batch
_PADDING = 16  # numbers that rows of a sample's table are padded to, as network.h reads them


@dataclass(frozen=True)
class ParameterInputs:
    """Numbers of a scene's physical parameters that differ between samples; the others are constants.

    Constants make short state maths: a planar scene's axes are zeros and ones. So only what was seen to differ, between
    the samples of a batch or from batch to batch, is an input.
    """

    values: tuple[np.ndarray, ...]  # of each of PhysicalParameters, without batch; the first sample's
    varies: tuple[np.ndarray, ...]  # bool, alike

    @classmethod
    def of(cls, parameters: PhysicalParameters, before: ParameterInputs | None) -> ParameterInputs:
        """Inputs of parameters; the ``before`` ones themselves if they fit."""
        flat = _flat(parameters)
        values = tuple(part[0].copy() for part in flat) if before is None else before.values
        found = tuple((part != value).any(0) for part, value in zip(flat, values, strict=True))
        if before is None:
            return cls(values, found)
        if not any((new & ~old).any() for new, old in zip(found, before.varies, strict=True)):
            return before
        return cls(values, tuple(new | old for new, old in zip(found, before.varies, strict=True)))

    def __len__(self) -> int:
        """Numbers P that differ."""
        return sum(int(varies.sum()) for varies in self.varies)

    def symbols(self, graph: Expressions) -> tuple[list[Any], list[Array]]:
        """New inputs of an expression graph, P of them, and arrays of those parameters that have some."""
        inputs, arrays, start = graph.inputs(3, len(self)), [], 0
        for value, varies in zip(self.values, self.varies, strict=True):
            if varies.any():
                array = value.astype(object)
                end = start + int(varies.sum())
                array[varies] = inputs[start:end]
                arrays.append(array)
                start = end
        return inputs, arrays

    def complete(self, symbolic: Iterable[Tensor]) -> PhysicalParameters:
        """All parameters: those that have inputs, in order, and the constants."""
        given = iter(symbolic)
        both = zip(self.values, self.varies, strict=True)
        return PhysicalParameters(*(next(given) if varies.any() else torch.from_numpy(value) for value, varies in both))

    def read(self, parameters: PhysicalParameters) -> Tensor:
        """Their values ``[B, P]`` float64; of parameters without batch, or without inputs, ``[1, P]``."""
        if not len(self):
            return torch.empty(1, 0, dtype=torch.float64, device="cpu")
        parts = [part[:, varies] for part, varies in zip(_flat(parameters), self.varies, strict=True)]
        count = max(map(len, parts))
        return torch.from_numpy(np.concatenate([np.broadcast_to(part, (count, part.shape[1])) for part in parts], 1))


class Samples:
    """What samples bring to a call: tables of their own, and their parameters ``[B or 1, P]``."""

    def __init__(self, tables: list[Tensor | None], parameters: Tensor) -> None:
        self.tables, self.parameters = tables, parameters
        sizes = {table.shape[1] for table in tables if table is not None} | {len(parameters)}
        self.count = max(sizes) if max(sizes) > 1 else None  # B; None: all samples have the same
        self._addresses = (ctypes.c_void_p * len(tables))(*(None if t is None else t.data_ptr() for t in tables))

    @property
    def empty(self) -> bool:
        """Whether they bring nothing."""
        return not self.parameters.shape[1] and all(table is None for table in self.tables)

    @classmethod
    def of(cls, layers: LayerList, parameters: Tensor, number: torch.dtype) -> Samples:
        """Of a list of layers, in the dtype of its sums."""
        found: list[Tensor | None] = []
        for table in (layer.table for layer in layers.layers):
            if table is None or table.ndim < 3:
                found.append(None)
            else:
                found.append(pad(table.detach().to(number), (0, -table.shape[-1] % _PADDING)).contiguous())
        return cls(found, parameters)

    def part(self, at: Tensor) -> Samples:
        """Those of some samples, ``[count]`` indices."""
        if self.count is None:
            return self
        tables = [None if table is None else table[:, at].contiguous() for table in self.tables]
        return Samples(tables, self.parameters[at] if len(self.parameters) > 1 else self.parameters)

    def bring(self, call: Any) -> None:
        """Add them to a call of the library; they must live as long as the call."""
        if any(table is not None for table in self.tables):
            call.sample_tables = ctypes.addressof(self._addresses)
        call.parameters = self.parameters.data_ptr()
        call.parameter_stride = self.parameters.shape[1] if len(self.parameters) > 1 else 0


def batch_of(parameters: PhysicalParameters) -> torch.Size:
    """Shape ``*B`` of the samples; those parameters that samples do not bring have none."""
    return max((value.shape[: value.ndim - dims] for value, dims in zip(parameters, _DIMS, strict=True)), key=len)


def _flat(parameters: PhysicalParameters) -> list[np.ndarray]:
    """Each parameter ``[B or 1, ...]``, float64."""
    parts = (value.detach().double().numpy() for value in parameters)
    ends = ((part, part.ndim - dims) for part, dims in zip(parts, _DIMS, strict=True))
    return [part.reshape(math.prod(part.shape[:end]), *part.shape[end:]) for part, end in ends]
