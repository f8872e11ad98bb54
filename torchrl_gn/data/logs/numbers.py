"""Numbers of a log's arrays: real ones, lengths of episodes, and time steps."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

EVEN = 0.01  # of a step, tolerance for rounded time steps and stamps


def real_numbers(name: str, values: np.ndarray) -> np.ndarray:
    """Return an array in float64; ValueError, naming it, unless it holds real numbers."""
    # A cast would drop the imaginary part of complex numbers, and the unit of times.
    if not np.iscomplexobj(values) and values.dtype.kind not in "mM":
        try:
            return values.astype(np.float64)
        except (TypeError, ValueError):
            pass
    raise ValueError(f"{name!r} holds {values.dtype}, not real numbers.")


def seconds(values: np.ndarray) -> np.ndarray:
    """Return times ``[R]`` in seconds, as they are, or of dates and durations from their first."""
    if values.dtype.kind not in "mM":
        return real_numbers("time", values)
    known = values[~np.isnat(values)]
    return (values - (known[0] if len(known) else 0)) / np.timedelta64(1, "s")  # NaN of missing ones


def episode_lengths(episode: np.ndarray) -> np.ndarray:
    """Return the rows of each episode by the episode of each row ``[R]``; a new one starts where it changes.

    ValueError if a row has none, or if rows of several episodes alternate.
    """
    if missing := np.flatnonzero(episode != episode).tolist():  # NaN, also among objects
        raise ValueError(f"'episode' is not a number at row {missing[0]}: give each row an episode.")
    begins = np.flatnonzero(np.r_[True, episode[1:] != episode[:-1]])
    if 2 * len(begins) > len(episode) and len(begins) > len(np.unique(episode.astype(str))):
        raise ValueError("rows of several episodes alternate: sort them by 'episode', and then by time.")
    return np.diff(np.r_[begins, len(episode)])


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


def common_timestep(
    own: Mapping[str, np.ndarray],
    time: np.ndarray | None,
    length: np.ndarray,
    given: float | None,
    *,
    even: bool,
    remedy: str = "",
) -> float:
    """Return the seconds between rows that all sources state.

    Args:
        own: the file's arrays that repeat the time step, by name.
        time: time stamp of each row ``[R]``.
        length: rows of each episode.
        given: the caller's number.
        even: refuse gaps between time stamps.
        remedy: end of the message if sources disagree.

    Raises:
        ValueError: if no source states a time step, sources disagree, or time stamps do not grow.
    """
    steps = np.zeros(0)
    if time is not None:
        steps = np.delete(np.diff(time), np.cumsum(length)[:-1] - 1)  # within episodes
        if np.isfinite(steps).any() and not (steps > 0).any():
            raise ValueError("its time stamps never grow within an episode: sort the rows by time.")
        if even and len(steps) and not np.allclose(steps, np.median(steps), rtol=EVEN, atol=0):
            raise ValueError(f"its time stamps are not even, {steps.min():g} to {steps.max():g} s: resample it first.")
        steps = steps[steps > 0]
    stated = {
        "timestep=": given,
        **{f"its {name}": _repeated(name, values) for name, values in own.items()},
        "its time stamps": float(np.median(steps)) if len(steps) else None,
    }
    stated = {who: step for who, step in stated.items() if step is not None}
    if not stated or not all(0 < step < np.inf for step in stated.values()):
        raise ValueError("it has no time step; pass timestep=SECONDS.")
    if max(stated.values()) > (1 + EVEN) * min(stated.values()):
        all_steps = " but ".join(f"{step:g} ({who})" for who, step in stated.items())
        raise ValueError(f"seconds between rows are {all_steps}; leave out the wrong one{remedy}.")
    return next(iter(stated.values()))


def _repeated(name: str, values: np.ndarray) -> float:
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
