"""Muon's update of weight matrices in compiled C++."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.dynamics.executors.native import library
from torchrl_gn.processor import native_threads


class _Matrix(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("parameter", "gradient", "moment")),
        *((name, ctypes.c_int64) for name in ("rows", "columns")),
    )


class _Options(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_double) for name in ("momentum", "rate")),
        ("polynomials", ctypes.c_void_p),
        ("count", ctypes.c_int64),
    )


def muon_update(
    parameters: Sequence[Tensor],
    moments: Sequence[Tensor],
    momentum: float,
    rate: float,
    polynomials: Sequence[tuple[float, float, float]],
) -> list[int]:
    """Update matrices ``[m, n]``, and their momentum, in place; return the indices of those that C++ cannot.

    The results do not depend on the number of threads.

    Args:
        parameters: with gradients.
        moments: momentum of each, of its shape.
        momentum: weight of the momentum before.
        rate: learning rate of square matrices.
        polynomials: linear, cubic and quintic coefficient of each that orthogonalises.

    Raises:
        NoCompilerError: if the C++ code cannot be built.
    """
    coefficients = np.array(polynomials, dtype=np.float64)
    options = _Options(momentum, rate, coefficients.ctypes.data, len(polynomials))
    rest, kinds = [], {kind: ([], []) for kind in library.DTYPES.values()}
    for index, (parameter, moment) in enumerate(zip(parameters, moments, strict=True)):
        gradient, kind = parameter.grad, library.DTYPES.get(parameter.dtype)
        tensors = (parameter, gradient, moment)
        if kind is None or not all(_is_plain(each, parameter) for each in tensors):
            rest.append(index)
            continue
        addresses = (each.data_ptr() for each in tensors if each is not None)
        kinds[kind][0].append(_Matrix(*addresses, *parameter.shape))
        kinds[kind][1].append(parameter)
    for kind, (matrices, changed) in kinds.items():
        if matrices:
            array = (_Matrix * len(matrices))(*matrices)
            code = library.load_library()
            code.gn_muon(kind, array, len(matrices), ctypes.byref(options), native_threads())
            torch.autograd.graph.increment_version(changed)
    return rest


def _is_plain(tensor: Tensor | None, like: Tensor) -> bool:
    """Whether it is numbers in a row on the processor, of a parameter's shape and dtype."""
    return (
        tensor is not None
        and tensor.shape == like.shape
        and tensor.dtype == like.dtype
        and tensor.is_cpu
        and tensor.layout == torch.strided
        and tensor.is_contiguous()
        and tensor.numel() > 0
    )
