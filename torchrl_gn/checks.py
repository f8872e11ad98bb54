"""Checks of options."""

from __future__ import annotations

from numbers import Integral


def check_count(name: str, value: int, least: int) -> None:
    """Raise ValueError unless an option is a whole number of at least ``least``; True and False are none."""
    if not isinstance(value, Integral) or isinstance(value, bool) or value < least:
        raise ValueError(f"{name}={value!r} must be a whole number, {least} or more.")


def checked_seed(seed: int) -> int:
    """Return a seed as an int; ValueError unless it is a whole number from 0 to 2**63 - 1. True and False are none."""
    if not isinstance(seed, Integral) or isinstance(seed, bool) or not 0 <= seed < 2**63:
        raise ValueError(f"seed={seed!r} must be a whole number from 0 to 2**63 - 1.")
    return int(seed)


def check_counts(**counts: int) -> None:
    """Raise ValueError unless all options are whole numbers of at least 1."""
    for name, value in counts.items():
        check_count(name, value, 1)
