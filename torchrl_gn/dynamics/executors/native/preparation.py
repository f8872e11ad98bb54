"""Preparation of a step for C++: time budgets can exclude it, and large scenes announce it."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar

LARGE = 30  # bodies from which preparation takes half a minute
_A_MINUTE = 1700.0  # squared number of bodies that is traced in a minute

_around: ContextVar[Callable[[], AbstractContextManager]] = ContextVar("around", default=nullcontext)


@contextmanager
def around_preparation(context: Callable[[], AbstractContextManager]) -> Iterator[None]:
    """Enter ``context()`` around each preparation within this block, for example to stop a clock."""
    token = _around.set(context)
    try:
        yield
    finally:
        _around.reset(token)


@contextmanager
def preparation(bodies: int) -> Iterator[None]:
    """Enter the context for preparing a step of ``bodies``; for large scenes, announce the minutes on stderr."""
    if bodies >= LARGE:
        minutes = max(1, round(bodies**2 / _A_MINUTE))
        sys.stderr.write(
            f"Preparing a step of {bodies} bodies for C++, once in this process: about {minutes} min, not"
            " counted as training time.\n"
        )
    with _around.get()(), _without_collection():
        yield


@contextmanager
def _without_collection() -> Iterator[None]:
    """Disable garbage collection: with the millions of objects of a trace it takes longer than the trace."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
