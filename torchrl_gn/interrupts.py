"""Deferral of interrupts (Ctrl-C and SIGTERM) until a piece of work is complete."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGTERM, signal.SIGINT)


class Interrupts:
    """Signal handler that defers interrupts while it holds, and else calls the previous handler."""

    def __init__(self) -> None:
        self._before: dict[int, Any] = {}
        self._waiting: list[int] = []
        self._held = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if self._held:
            self._waiting.append(number)
        else:
            self._hand_on(number, frame)

    @property
    def waiting(self) -> bool:
        """True if an interrupt is deferred."""
        return bool(self._waiting)

    def let_in(self) -> None:
        """Deliver the first deferred interrupt, usually as KeyboardInterrupt; drop the others, which mean the same."""
        if self._waiting:
            number = self._waiting[0]
            self._waiting.clear()
            self._hand_on(number, None)

    def _hand_on(self, number: int, frame: FrameType | None) -> None:
        before = self._before[number]
        if callable(before):
            before(number, frame)
        else:  # the system's default handler, which ends the process
            signal.signal(number, before)
            signal.raise_signal(number)

    def _begin(self) -> None:
        for number in _SIGNALS:
            before = signal.getsignal(number)
            if before not in (signal.SIG_IGN, None):
                self._before[number] = before
                signal.signal(number, self)
        self._held = True

    def _end(self) -> None:
        # Before handlers are restored one by one, so that an interrupt in between is delivered.
        self._held = False
        for number, before in self._before.items():
            signal.signal(number, before)


@contextmanager
def held() -> Iterator[Interrupts]:
    """Defer Ctrl-C and SIGTERM until the block ends or calls :meth:`Interrupts.let_in`.

    If the block raises, deferred interrupts are dropped. Blocks nest. Only the main thread receives interrupts; in
    other threads blocks do nothing.
    """
    interrupts = Interrupts()
    if threading.current_thread() is not threading.main_thread():
        yield interrupts
        return
    try:
        interrupts._begin()
        yield interrupts
    finally:
        interrupts._end()
    interrupts.let_in()


@contextmanager
def let_in_at_once() -> Iterator[None]:
    """Deliver interrupts at once in the block, despite enclosing :func:`held`: for long work that may be aborted."""
    holding: list[Interrupts] = []
    if threading.current_thread() is threading.main_thread():
        for number in _SIGNALS:
            handler = signal.getsignal(number)
            while isinstance(handler, Interrupts):
                if handler not in holding:
                    holding.append(handler)
                handler = handler._before[number]
    try:
        for each in reversed(holding):  # outermost first, else it would defer an inner one's interrupt again
            each._held = False
            each.let_in()
        yield
    finally:
        for each in holding:
            each._held = True
