"""Checks of options."""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from numbers import Integral
from typing import Any


def check_count(name: str, value: int, least: int) -> None:
    """Raise ValueError unless an option is a whole number of at least ``least``; True and False are none."""
    if not isinstance(value, Integral) or isinstance(value, bool) or value < least:
        raise ValueError(f"{name}={value!r} must be a whole number, {least} or more.")


def checked_seed(seed: int) -> int:
    """Return a seed as an int; ValueError unless it is a whole number from 0 to 2**63 - 1. True and False are none."""
    if not isinstance(seed, Integral) or isinstance(seed, bool) or not 0 <= seed < 2**63:
        raise ValueError(f"seed={seed!r} must be a whole number from 0 to 2**63 - 1.")
    return int(seed)


def sorted_horizons(horizons: Iterable[int]) -> tuple[int, ...]:
    """Return distinct numbers of steps in order; ValueError unless they are whole numbers of at least 1."""
    if isinstance(horizons, str) or not isinstance(horizons, Iterable):
        raise ValueError(f"horizons={horizons!r} must be a sequence of numbers of steps, such as (20, 100).")
    numbers = list(horizons)
    for number in numbers:
        check_count("each of horizons", number, 1)
    return tuple(sorted({int(number) for number in numbers}))


def check_counts(**counts: int) -> None:
    """Raise ValueError unless all options are whole numbers of at least 1."""
    for name, value in counts.items():
        check_count(name, value, 1)


def refuse_closure(optimizer: Any) -> None:
    """Raise TypeError, naming the optimiser, if its steps need a closure, as those of LBFGS."""
    closure = inspect.signature(optimizer.step).parameters.get("closure")
    if closure is not None and closure.default is closure.empty:
        raise TypeError(
            f"{type(optimizer).__name__} needs a closure that computes the loss several times a step, on one batch:"
            " use an optimiser for random batches, such as Adam or SGD."
        )
