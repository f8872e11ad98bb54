"""How long a training may take, in steps or minutes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Budget:
    """A limit on optimiser steps or on training minutes; exactly one of them.

    Attributes:
        steps: optimiser steps.
        minutes: wall-clock minutes of training, over all resumed runs together.

    Raises:
        ValueError: if both or none are given, or the limit is not positive.
    """

    steps: int | None = None
    minutes: float | None = None

    def __post_init__(self) -> None:
        if (self.steps is None) == (self.minutes is None):
            raise ValueError(f"Give either steps or minutes, not steps={self.steps} and minutes={self.minutes}.")
        if not self.limit > 0:
            raise ValueError(f"A training budget must be positive, got {self.limit}.")

    @property
    def limit(self) -> float:
        """Steps or minutes."""
        return self.steps if self.steps is not None else self.minutes or 0.0

    def fraction(self, step: int, seconds: float) -> float:
        """Share of the budget that is spent, 0 to 1."""
        return min((step if self.steps is not None else seconds / 60) / self.limit, 1.0)
