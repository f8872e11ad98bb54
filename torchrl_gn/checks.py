"""Checks of options."""

from __future__ import annotations

from numbers import Integral


def check_count(name: str, value: int, least: int) -> None:
    """Raise ValueError unless an option is a whole number of at least ``least``; True and False are none."""
    if not isinstance(value, Integral) or isinstance(value, bool) or value < least:
        raise ValueError(f"{name}={value!r} must be a whole number, {least} or more.")


def check_counts(**counts: int) -> None:
    """Raise ValueError unless all options are whole numbers of at least 1."""
    for name, value in counts.items():
        check_count(name, value, 1)
