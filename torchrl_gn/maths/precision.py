"""Faster float32 matrix products, for as long as a block lasts."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import torch

from torchrl_gn.processor import onednn_precision, product_speeds


@contextmanager
def fast_matmul(*, rounding: bool = False) -> Iterator[None]:
    """Let the hardware choose how float32 matrices are multiplied.

    On a CPU the products go through oneDNN where that was timed to be faster with the same digits
    (:func:`~torchrl_gn.processor.product_speeds`; nearly twice on an AMD EPYC with AVX-512, no gain with AVX2).
    Processors with matrix units (AMX) would round to bfloat16 there, which no training to errors below a millionth
    survives, so that is asked for by ``rounding``, and so is TF32 on an NVIDIA GPU. The settings are put back after.
    Before torch 2.9, which has no such setting for a CPU, its products stay as they are.

    Args:
        rounding: allow products of factors that are rounded to 8 (CPU) or 11 (GPU) bits.
    """
    with ExitStack() as settings:
        cpu, cuda = onednn_precision(), torch.backends.cuda.matmul
        if cpu is not None and (rounding or product_speeds().onednn_pays):
            settings.enter_context(_set(cpu, "bf16"))
        if rounding and hasattr(cuda, "fp32_precision"):
            settings.enter_context(_set(cuda, "tf32"))
        yield


@contextmanager
def _set(backend: Any, precision: str) -> Iterator[None]:
    before, backend.fp32_precision = backend.fp32_precision, precision
    try:
        yield
    finally:
        backend.fp32_precision = before
