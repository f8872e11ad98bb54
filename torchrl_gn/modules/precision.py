"""Faster float32 matrix products, for as long as a block lasts."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def fast_matmul(*, rounding: bool = False) -> Iterator[None]:
    """Let the hardware choose how float32 matrices are multiplied.

    On a CPU the products go through oneDNN, which on some processors is faster than the default library
    with the same digits (measured: twice on an AMD EPYC). Processors with matrix units (AMX)
    would round to bfloat16 there, which no training to errors below a millionth survives, so that is asked for
    by ``rounding``, and so is TF32 on an NVIDIA GPU. The settings are put back after.

    Args:
        rounding: allow products of factors that are rounded to 8 (CPU) or 11 (GPU) bits.
    """
    cpu, cuda = torch.backends.mkldnn.matmul, torch.backends.cuda.matmul  # pyright: ignore
    before = cpu.fp32_precision, cuda.fp32_precision
    if rounding or _onednn_keeps_digits():
        cpu.fp32_precision = "bf16"
    if rounding:
        cuda.fp32_precision = "tf32"
    try:
        yield
    finally:
        cpu.fp32_precision, cuda.fp32_precision = before


@functools.cache
def _onednn_keeps_digits() -> bool:
    """Whether oneDNN multiplies in full float32 when it may round; tried once, as processors differ."""
    cpu = torch.backends.mkldnn.matmul  # pyright: ignore
    factor = torch.randn(256, 256, generator=torch.Generator().manual_seed(0))
    exact, before = factor.double() @ factor.double(), cpu.fp32_precision
    cpu.fp32_precision = "bf16"
    try:
        error = (factor @ factor - exact).norm() / exact.norm()
    finally:
        cpu.fp32_precision = before
    return bool(error < 1e-5)
