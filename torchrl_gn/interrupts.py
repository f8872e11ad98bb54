"""Interrupts, Ctrl-C and SIGTERM, that wait until work is whole."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGTERM, signal.SIGINT)


class Interrupts:
    """Interrupts that wait; as a signal handler it keeps them, or hands them on to the handler before it."""

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
        """Whether one waits."""
        return bool(self._waiting)

    def let_in(self) -> None:
        """Hand on the first that waits, as a rule as KeyboardInterrupt; the others ask for the same."""
        if self._waiting:
            number = self._waiting[0]
            self._waiting.clear()
            self._hand_on(number, None)

    def _hand_on(self, number: int, frame: FrameType | None) -> None:
        before = self._before[number]
        if callable(before):
            before(number, frame)
        else:  # the system's own: the process ends
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
        # First of all, as handlers are put back one by one: an interrupt in between is handed on.
        self._held = False
        for number, before in self._before.items():
            signal.signal(number, before)


@contextmanager
def held() -> Iterator[Interrupts]:
    """Hold Ctrl-C and SIGTERM back until the block ends, or lets them in by :meth:`Interrupts.let_in`.

    If the block raises, what waits is dropped. Blocks nest; those of other threads than the main one, which no
    interrupt reaches, do nothing.
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
    """Let interrupts in within the block, whatever holds them back: for long work that can be given up."""
    holding: list[Interrupts] = []
    if threading.current_thread() is threading.main_thread():
        for number in _SIGNALS:
            handler = signal.getsignal(number)
            while isinstance(handler, Interrupts):
                if handler not in holding:
                    holding.append(handler)
                handler = handler._before[number]
    try:
        for each in reversed(holding):  # the outermost first, so that nothing stops at it
            each._held = False
            each.let_in()
        yield
    finally:
        for each in holding:
            each._held = True
