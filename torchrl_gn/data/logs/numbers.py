"""Numbers of a log's arrays: real ones, lengths of episodes, and time steps."""

from __future__ import annotations

import numpy as np

EVEN = 0.01  # of a step, tolerance for rounded time steps and stamps


def real_numbers(name: str, values: np.ndarray) -> np.ndarray:
    """Return an array in float64; ValueError, naming it, unless it holds real numbers."""
    if not np.iscomplexobj(values):  # a cast would drop the imaginary part
        try:
            return values.astype(np.float64)
        except (TypeError, ValueError):
            pass
    raise ValueError(f"{name!r} holds {values.dtype}, not real numbers.")


def row_counts(length: np.ndarray, rows: int | None) -> np.ndarray:
    """Return the rows of each episode ``[episodes]``; ValueError unless they are whole and positive.

    They must add up to ``rows``, unless it is None.
    """
    numbers = np.atleast_1d(real_numbers("length", np.asarray(length))).reshape(-1)
    wrong = numbers[~(np.isfinite(numbers) & (numbers == np.round(numbers)) & (numbers >= 1))]
    if wrong.size:
        raise ValueError(f"length must be whole numbers of rows, 1 or more, of each episode; it has {wrong[0]:g}.")
    if rows is not None and numbers.sum() != rows:
        raise ValueError(f"length adds up to {numbers.sum():g} rows, but there are {rows}.")
    return numbers.astype(np.int64)


def even_timestep(name: str, values: np.ndarray) -> float:
    """Return the time step that an array repeats, in seconds; ValueError if it is empty, not finite or varies."""
    steps = real_numbers(name, np.asarray(values)).reshape(-1)
    if not steps.size or not np.isfinite(steps).all():
        raise ValueError(f"it has no time step: {name!r} must be finite seconds between rows.")
    if np.ptp(steps) > EVEN * abs(steps[0]):
        raise ValueError(
            f"{name!r} varies from {steps.min():g} to {steps.max():g} s: give the time of each row instead, as 'time',"
            " and leave it out."
        )
    return float(np.median(steps))
