"""How long a training may take, in steps or minutes."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

_CLOCKS = {"wall": time.perf_counter, "processor": time.process_time}


@dataclass(frozen=True)
class Budget:
    """A limit on optimiser steps or on training minutes; exactly one of them.

    Attributes:
        steps: optimiser steps.
        minutes: minutes of training, over all resumed runs together.
        clock: which minutes: ``"wall"``, or the ``"processor"``'s, which do not pass faster on a busy
            machine (count one thread: threads add up).

    Raises:
        ValueError: if both or none are given, the limit is not positive and finite, or there is no such clock.
    """

    steps: int | None = None
    minutes: float | None = None
    clock: str = "wall"

    def __post_init__(self) -> None:
        if self.clock not in _CLOCKS:
            raise ValueError(f"clock={self.clock!r} is not known; use one of {list(_CLOCKS)}.")
        if (self.steps is None) == (self.minutes is None):
            raise ValueError(f"Give either steps or minutes, not steps={self.steps} and minutes={self.minutes}.")
        if not 0 < self.limit < math.inf:
            name = "steps" if self.minutes is None else "minutes"
            raise ValueError(f"A training budget must be positive and finite, got {name}={self.limit}.")

    @property
    def limit(self) -> float:
        """Steps or minutes."""
        return self.steps if self.steps is not None else self.minutes or 0.0

    def now(self) -> float:
        """Seconds of the clock, from any start."""
        return _CLOCKS[self.clock]()

    def fraction(self, step: int, seconds: float) -> float:
        """Share of the budget that is spent, 0 to 1."""
        return min((step if self.steps is not None else seconds / 60) / self.limit, 1.0)
