"""Limits of a training: optimiser steps, minutes, or both."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

from torchrl_gn.checks import check_count

_CLOCKS = {"wall": time.perf_counter, "processor": time.process_time}


@dataclass(frozen=True)
class Budget:
    """Limits on optimiser steps, training minutes or both; training ends at the first one reached."""

    steps: int | None = None
    minutes: float | None = None  # summed over resumed runs
    clock: str = "wall"  # or "processor", which sums over threads

    def __post_init__(self) -> None:
        if self.clock not in _CLOCKS:
            raise ValueError(f"clock={self.clock!r} is not known; use one of {list(_CLOCKS)}.")
        if self.steps is None and self.minutes is None:
            raise ValueError("A training budget needs a limit: give steps, minutes or both.")
        if self.steps is not None:
            check_count("steps", self.steps, 1)
        if self.minutes is not None and (isinstance(self.minutes, bool) or not 0 < self.minutes < math.inf):
            raise ValueError(f"minutes={self.minutes} must be positive and finite.")

    def now(self) -> float:
        """Read the clock, in seconds."""
        return _CLOCKS[self.clock]()

    def fraction(self, step: int, seconds: float, *, windows: float = 0.0, window_cost: float = 1.0) -> float:
        """Return the spent share of the budget, 0 to 1: the larger of the shares of steps and of minutes.

        Args:
            step: number of finished steps.
            seconds: time of these steps.
            windows: share of the work that trains on windows, at the end.
            window_cost: cost of a step on windows, in other steps.
        """
        by_steps = 0.0 if self.steps is None else _work_share(step / self.steps, windows, window_cost)
        by_time = 0.0 if self.minutes is None else seconds / 60 / self.minutes
        return min(max(by_steps, by_time), 1.0)

    def is_cut_short(self, step: int, seconds: float) -> bool:
        """Return whether the minutes ran out before the steps."""
        if self.steps is None or self.minutes is None:
            return False
        return step < self.steps and seconds >= 60 * self.minutes


def _work_share(steps: float, windows: float, cost: float) -> float:
    """Convert a share of the steps to a share of the work, where steps of the last ``windows`` share cost more."""
    if windows == 0:
        return steps
    single = (1 - windows) * cost / ((1 - windows) * cost + windows)  # share of the steps before the windows
    if steps < single:
        return (1 - windows) * steps / single
    return 1 - windows * (1 - steps) / (1 - single)
