"""How long a training may take: an amount of work, a time, or both."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

_CLOCKS = {"wall": time.perf_counter, "processor": time.process_time}


@dataclass(frozen=True)
class Budget:
    """Limits on optimiser steps and on training minutes; a training ends at the first that it reaches.

    Steps alone give the same training on every machine. Minutes beside them are a cap for slow ones.

    Attributes:
        steps: optimiser steps; None: no limit.
        minutes: minutes of training, over all resumed runs together; None: no limit.
        clock: which minutes: ``"wall"``, or the ``"processor"``'s, which do not pass faster on a busy
            machine (count one thread: threads add up).

    Raises:
        ValueError: if there is no limit, one is not positive and finite, or there is no such clock.
    """

    steps: int | None = None
    minutes: float | None = None
    clock: str = "wall"

    def __post_init__(self) -> None:
        if self.clock not in _CLOCKS:
            raise ValueError(f"clock={self.clock!r} is not known; use one of {list(_CLOCKS)}.")
        limits = {name: limit for name in ("steps", "minutes") if (limit := getattr(self, name)) is not None}
        if not limits:
            raise ValueError("A training budget needs a limit: give steps, minutes or both.")
        for name, limit in limits.items():
            if not 0 < limit < math.inf:
                raise ValueError(f"A training budget must be positive and finite, got {name}={limit}.")

    def now(self) -> float:
        """Seconds of the clock, from any start."""
        return _CLOCKS[self.clock]()

    def fraction(self, step: int, seconds: float, *, windows: float = 0.0, window_cost: float = 1.0) -> float:
        """Share of the budget that is spent, 0 to 1: of its steps or its minutes, whichever is more.

        Args:
            step: optimiser steps done.
            seconds: training seconds spent.
            windows: share of the work that goes to updates on windows, at the end.
            window_cost: work of such an update, in updates on single transitions.
        """
        by_steps = 0.0 if self.steps is None else _work(step / self.steps, windows, window_cost)
        by_time = 0.0 if self.minutes is None else seconds / 60 / self.minutes
        return min(max(by_steps, by_time), 1.0)

    def is_cut_short(self, step: int, seconds: float) -> bool:
        """Whether the minutes ended a training before its steps were done."""
        if self.steps is None or self.minutes is None:
            return False
        return step < self.steps and seconds >= 60 * self.minutes


def _work(share: float, windows: float, cost: float) -> float:
    """Share of the work done after a share of the steps, where those of the last ``windows`` of the work cost more."""
    if windows == 0:
        return share
    plain = (1 - windows) * cost / ((1 - windows) * cost + windows)  # share of the steps before the windows
    if share < plain:
        return (1 - windows) * share / plain
    return 1 - windows * (1 - share) / (1 - plain)
