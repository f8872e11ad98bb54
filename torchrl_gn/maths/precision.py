"""Precision of matrix products."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, ParamSpec, TypeVar

import torch

from torchrl_gn.processor import onednn_precision, product_speeds

P = ParamSpec("P")
T = TypeVar("T")
_DEVICES = ("cpu", "cuda", "mps", "xpu")


def without_autocast(function: Callable[P, T]) -> Callable[P, T]:
    """Decorate a function to run without ``torch.autocast``.

    16-bit positions are off by centimetres, and merged weights would be rounded twice: when merged and when used.
    """

    @functools.wraps(function)
    def exactly(*args: P.args, **kwargs: P.kwargs) -> T:
        devices = [device for device in _DEVICES if torch.is_autocast_enabled(device)]
        if not devices:
            return function(*args, **kwargs)
        with ExitStack() as settings:
            for device in devices:
                settings.enter_context(torch.autocast(device, enabled=False))
            return function(*args, **kwargs)

    return exactly


@contextmanager
def fast_matmul(*, rounding: bool = False) -> Iterator[None]:
    """Use the hardware's fastest float32 matrix products until the block ends.

    A CPU uses oneDNN if it was measured to be faster at the same precision
    (:func:`~torchrl_gn.processor.product_speeds`). On a CPU with torch before 2.9 nothing changes.

    Args:
        rounding: allow rounded factors: to 8 significant bits on a CPU with AMX (bfloat16), to 11 on an NVIDIA GPU
            (TF32).
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
