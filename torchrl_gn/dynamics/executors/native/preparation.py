"""How long a step is prepared for C++: whoever budgets time may leave it out, and large scenes say it."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar

LARGE = 30  # bodies from which it takes half a minute
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
    """Prepare a step of so many bodies; of many it says on stderr that this takes minutes."""
    if bodies >= LARGE:
        minutes = max(1, round(bodies**2 / _A_MINUTE))
        sys.stderr.write(
            f"Preparing a step of {bodies} bodies for C++, once in this process: about {minutes} min, which the"
            " minutes of a training do not count.\n"
        )
    with _around.get()(), _without_collection():
        yield


@contextmanager
def _without_collection() -> Iterator[None]:
    """Leave out the search for reference cycles: of a trace's millions of objects it takes longer than the trace."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
