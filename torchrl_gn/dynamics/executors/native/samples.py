"""Per-sample physical parameters: which of them the state maths reads as inputs, and their values."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.dynamics.executors.native.trace import Array
from torchrl_gn.dynamics.program import StepProgram, numbers_of, parameter_inputs
from torchrl_gn.scenes.physical_parameters import PhysicalParameters

_DIMS = (2, 2, 1, 2, 1, 1, 2, 2, 3, 2, 2, 2, 3, 2, 3, 2)  # dimensions of each physical parameter, without batch


@dataclass(frozen=True)
class ParameterInputs:
    """Numbers of a scene's physical parameters that may differ between samples; the others are constants.

    Constants shorten the state maths: the axes of a planar scene are zeros and ones.
    """

    values: tuple[np.ndarray, ...]  # the scene's own value of each physical parameter
    varies: tuple[np.ndarray, ...]  # bool, of the same shapes: numbers that may differ

    @classmethod
    def of(cls, program: StepProgram) -> ParameterInputs:
        """Select the inputs of a program that has per-sample parameters."""
        values = tuple(part[0] for part in _flat(program.standard))
        return cls(values, tuple(mask.numpy() for mask in parameter_inputs(program)))

    def __len__(self) -> int:
        """Return the number P of inputs."""
        return sum(int(varies.sum()) for varies in self.varies)

    def arrays(self, inputs: Sequence[Any]) -> list[Array]:
        """Return each parameter that has inputs, as an array with its part of the P ``inputs`` filled in."""
        arrays, start = [], 0
        for value, varies in zip(self.values, self.varies, strict=True):
            if varies.any():
                array = value.astype(object)
                end = start + int(varies.sum())
                array[varies] = inputs[start:end]
                arrays.append(array)
                start = end
        return arrays

    def complete(self, symbolic: Iterable[Tensor]) -> PhysicalParameters:
        """Return all parameters: ``symbolic`` ones, in order, where a parameter has inputs, else constants."""
        values = iter(symbolic)
        both = zip(self.values, self.varies, strict=True)
        return PhysicalParameters(
            *(next(values) if varies.any() else torch.from_numpy(value) for value, varies in both)
        )

    def read(self, parameters: PhysicalParameters) -> Tensor:
        """Return the values of the inputs, ``[B, P]`` float64; ``[1, P]`` without batch or without inputs."""
        if not len(self):
            return torch.empty(1, 0, dtype=torch.float64, device="cpu")
        if not parameters[0].is_cpu:
            return self._read_there(parameters)
        parts = [part[:, varies] for part, varies in zip(_flat(parameters), self.varies, strict=True)]
        count = max(map(len, parts))
        return torch.from_numpy(np.concatenate([np.broadcast_to(part, (count, part.shape[1])) for part in parts], 1))

    def numbers(self, program: StepProgram) -> Tensor:
        """Return the numbers of the model and of samples that the state maths reads, ``[1 or B, P]`` float64."""
        parts = [part.reshape(-1) for part in numbers_of(program)] or [program.reference.new_empty(0)]
        numbers = torch.cat(parts).double().unsqueeze(0)
        if len(self):
            parameters = self.read(program.parameters)
            numbers = torch.cat((numbers.expand(len(parameters), -1), parameters), 1)
        return numbers.contiguous()

    def _read_there(self, parameters: PhysicalParameters) -> Tensor:
        """Return :meth:`read`'s values on another device, without synchronising with it."""
        parts = []
        for value, varies, dims in zip(parameters, self.varies, _DIMS, strict=True):
            flat = value.detach().double().reshape(math.prod(value.shape[: value.ndim - dims]), -1)
            parts.append(flat[:, torch.from_numpy(np.flatnonzero(varies)).to(flat.device)])
        count = max(map(len, parts))
        return torch.cat([part.expand(count, -1) for part in parts], 1)


def batch_of(parameters: PhysicalParameters) -> torch.Size:
    """Return the batch ``*B`` of the per-sample parameters; the scene's own have none."""
    return max((value.shape[: value.ndim - dims] for value, dims in zip(parameters, _DIMS, strict=True)), key=len)


def _flat(parameters: PhysicalParameters) -> list[np.ndarray]:
    """Return each parameter as ``[B or 1, ...]``, float64."""
    parts = (value.detach().double().numpy() for value in parameters)
    ends = ((part, part.ndim - dims) for part, dims in zip(parts, _DIMS, strict=True))
    return [part.reshape(math.prod(part.shape[:end]), *part.shape[end:]) for part, end in ends]
