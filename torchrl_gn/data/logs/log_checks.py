"""Checks of a log's numbers for wrong units, wrong signs and shuffled rows."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence

import numpy as np

from torchrl_gn.data.logs.robot_log import RobotLog, short_way, unbroken

_WINDOW = 16  # rows over which velocities are integrated, so that noise and filter lag matter little
_FEWEST = 20  # fewest windows (or rows) for a check
_CLEAR = 0.8  # correlation above which velocities match the angles, whatever their unit
_DOUBTFUL, _IMPOSSIBLE = 1.5, 5.0  # factor between velocities and changes that raises a warning, an error
_LARGE = 0.05  # rad, standard deviation above which an angle moves
_LONE = 5.0  # factor on the changes around, and on usual ones, above which a change is a jump
LEAST_JUMP = 0.01  # m or rad
_SLOWEST, _FASTEST = 1.0, 1e-5  # seconds between rows; the unit is likely wrong beyond these
_UNITS = {
    180 / np.pi: "velocities in degrees/s",
    np.pi / 180: "angles in degrees",
    1e3: "times in milliseconds",
    1e6: "times in microseconds",
    1e9: "times in nanoseconds",
}

_UNIT = r"[\s_.(\[]*(?:s|ms|us|ns|n?secs?|seconds)?[)\]]*"
_ROLES = {  # names that reveal the role of a column, by role
    "time": rf"(?:(?:.*[\s_./])?(?:time|times|timestamps?|stamps?)|t|ts|clock){_UNIT}|n?secs?|seconds",
    "timestep": r"dt|time[\s_]?steps?[\s_]?(?:size)?",
    "episode": r"(?:ep|episode|trial|trajectory|traj|demo|rollout)(?:[\s_.]?(?:index|idx|id|number|nr|no))?",
    "end": r"(?:.*[\s_./])?(?:dones?|terminals?|terminated|truncated|timeouts?|resets?|is_first|is_last|is_terminal)",
}
_COUNTS = 0.9  # share of a column's steps that are alike if it counts rows


class LogContentWarning(UserWarning):
    """A log's numbers are implausible, for example in another unit."""


def gain_and_correlation(change: np.ndarray, explained: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Regress integrated velocities ``explained`` on changes, both ``[n, J]``; return slope, correlation ``[J]``."""
    cross_product, square = (change * explained).sum(0), np.square(change).sum(0)
    correlation = cross_product / np.maximum(np.sqrt(square * np.square(explained).sum(0)), 1e-30)
    return cross_product / np.maximum(square, 1e-30), correlation


def check_velocities(gain: np.ndarray, correlation: np.ndarray, what: Sequence[str]) -> None:
    """Refuse velocities of the wrong sign or unit, or warn of them; ``what`` names the velocities.

    Raises:
        ValueError: if velocities have the opposite sign, or are over five times too large or too small.
    """
    clear = np.abs(correlation) > _CLEAR
    if opposite := np.flatnonzero(clear & (gain < 0)).tolist():
        first = opposite[0]
        raise ValueError(
            f"velocities of {', '.join(what[index] for index in opposite)} have the opposite sign of the changes"
            f" (correlation {correlation[first]:.2f}): turn the sign of one, or leave the velocities out"
        )
    size = np.abs(np.log(np.where(clear, np.maximum(gain, 1e-30), 1)))
    worst = int(size.argmax())
    if size[worst] < np.log(_DOUBTFUL):
        return
    text = (
        f"velocities of {what[worst]} are {gain[worst]:.3g} times the changes over the time step"
        f" (correlation {correlation[worst]:.2f}){_unit(gain[worst])}"
    )
    if size[worst] > np.log(_IMPOSSIBLE):
        raise ValueError(f"{text}. Give all in SI units, or leave the velocities out")
    warnings.warn(f"{text}. Are units and time step right?", LogContentWarning, stacklevel=2)


def likely_role(name: str, values: np.ndarray, rows: int) -> str | None:
    """Guess the role of an array with another name, from its name, shape or numbers; None without a guess.

    The roles are names that files have, and ``"end"``, flags of episodes' ends, and ``"count"`` of rows.
    """
    if values.shape in ((rows,), (rows, 1)):
        name = name.strip()
        named = next((role for role, words in _ROLES.items() if re.fullmatch(words, name, re.IGNORECASE)), None)
        return named or ("count" if _counts(values.reshape(-1)) else None)
    counts = values.ndim == 1 and len(values) > 1 and np.issubdtype(values.dtype, np.integer)
    return "length" if counts and values.min() > 0 and values.sum() == rows else None


def cuts_episodes(flags: np.ndarray, length: np.ndarray) -> bool:
    """Return True if flags ``[R]`` or ``[R, 1]`` of ends or starts are set inside an episode, by the rows of each.

    NaN is not set. Flags that are not numbers cut nothing.
    """
    if flags.dtype.kind not in "buif":
        return False
    last = np.cumsum(length) - 1
    inside = np.ones(len(flags), dtype=bool)
    inside[last] = inside[last - length + 1] = False
    return bool(inside[np.nan_to_num(flags.reshape(-1)).astype(bool)].any())


def _counts(values: np.ndarray) -> bool:
    """Return True if values ``[R]`` grow by the same step from nearly every row to the next, as an index of rows."""
    if len(values) < _FEWEST or not np.issubdtype(values.dtype, np.number) or np.iscomplexobj(values):
        return False
    steps = np.diff(values.astype(np.float64))
    usual = np.median(steps)
    return bool(usual > 0 and (np.abs(steps - usual) <= 1e-3 * usual).mean() >= _COUNTS)


def lone_jumps(change: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Detect changes from row to row that are far larger than all others around them, as at a reset.

    Args:
        change: ``[R - 1, B, k]``, metres or radians.
        inside: mask ``[R - 1]`` of changes within an episode.

    Returns:
        Mask ``[R - 1, B]``.
    """
    size = np.where(inside[:, None], np.linalg.norm(change, axis=-1), np.nan)
    if inside.sum() < _FEWEST:
        return np.zeros(size.shape, dtype=bool)
    edge = np.full((2, size.shape[1]), np.nan)
    padded = np.concatenate((edge, size, edge))
    around = np.stack([padded[shift : shift + len(size)] for shift in (0, 1, 3, 4)])
    known = np.isfinite(around).any(0)
    around = np.where(np.isfinite(around), around, 0).max(0)
    usual = np.nanquantile(size, 0.9, axis=0)
    with np.errstate(invalid="ignore"):
        return known & (size > np.maximum(_LONE * np.maximum(around, usual), LEAST_JUMP))


def check_timestep(timestep: float) -> None:
    """Warn if the time between rows, in seconds, is implausible for a robot's log."""
    if not _FASTEST <= timestep < _SLOWEST:
        warnings.warn(
            f"The log has {timestep:g} s between rows: are its times in another unit than seconds?",
            LogContentWarning,
            stacklevel=2,
        )


def check_robot_log(log: RobotLog, *, degrees: bool, measured: bool) -> None:
    """Refuse a log whose numbers contradict each other, or warn of it.

    Args:
        degrees: the log was converted from degrees.
        measured: velocities come from the file and are not differences of angles.

    Raises:
        ValueError: if rows are out of order, or :func:`check_velocities` refuses the velocities.
    """
    inside = log.inside & np.isfinite(log.steps)
    back = int((inside & (log.steps <= 0)).sum())
    if back > 0.1 * max(1, inside.sum()):
        raise ValueError(
            f"{back:,} of {int(inside.sum()):,} rows are not later than the row before: sort them by time, or say where"
            " episodes begin"
        )
    check_timestep(log.timestep)
    parts = unbroken(log, 50.0)
    _check_order(log, inside & ~log.gaps)
    _check_degrees(log, degrees)
    change, explained = [], []
    for part in parts if measured else ():
        count = (part.stop - part.start - 1) // _WINDOW * _WINDOW
        rows = slice(part.start, part.start + count + 1)
        if not count:
            continue
        steps = log.steps[rows.start : rows.stop - 1, None]
        mean = (log.velocity[rows][1:] + log.velocity[rows][:-1]) / 2 * steps
        both = short_way(np.diff(log.angle[rows], axis=0)), mean
        for sums, each in zip((change, explained), both, strict=True):
            sums.append(each.reshape(-1, _WINDOW, log.num_joints).sum(1))
    if sum(map(len, change)) >= _FEWEST:
        statistics = gain_and_correlation(np.concatenate(change), np.concatenate(explained))
        check_velocities(*statistics, [f"joint {joint}" for joint in range(log.num_joints)])


def _check_order(log: RobotLog, inside: np.ndarray) -> None:
    """Raise ValueError if angles jump as in shuffled rows, far more than velocities explain."""
    good = inside & log.finite[1:] & log.finite[:-1]
    if good.sum() < _FEWEST:
        return
    change = short_way(np.diff(log.angle, axis=0)[good])
    slow = np.abs((log.velocity[1:] + log.velocity[:-1])[good] / 2 * log.steps[good, None])
    spread = np.minimum(log.angle[log.finite].std(0), np.pi / np.sqrt(3))  # at most that of a uniform angle
    moves = spread > _LARGE
    # Half the mean squared change over the variance: 1 for independent rows, near 0 for continuous motion.
    ratio = np.square(change).mean(0) / np.maximum(2 * np.square(spread), 1e-30)
    shuffled = moves & (ratio > 0.5) & (np.median(np.abs(change), axis=0) > 3 * np.median(slow, axis=0))
    if moves.any() and shuffled.sum() > 0.5 * moves.sum():
        joint = int(np.flatnonzero(shuffled)[0])
        raise ValueError(
            f"the angle of joint {joint} changes by {np.median(np.abs(change[:, joint])):.2g} rad from row to row, but"
            f" velocities say {np.median(slow[:, joint]):.2g}: its rows are not in the order of time, or angles not in"
            " radians"
        )


def _check_degrees(log: RobotLog, degrees: bool) -> None:
    farthest = np.nanmax(np.where(np.isfinite(log.angle), np.abs(log.angle), 0), axis=0)
    usual = float(np.median(farthest))
    if not degrees and usual > 4 * np.pi:
        hint = f"Angles reach {usual:.3g} rad, {usual / (2 * np.pi):.2g} turns: if they are degrees, pass degrees=True."
    elif degrees and 0 < farthest.max() < np.deg2rad(2 * np.pi):
        hint = f"Angles reach {np.rad2deg(farthest.max()):.3g} degrees: if they are radians, leave out degrees=True."
    else:
        return
    warnings.warn(hint, LogContentWarning, stacklevel=2)


def _unit(gain: float) -> str:
    for known, unit in _UNITS.items():
        if 0.9 < gain / known < 1.1:
            return f", as of {unit}"
    return ""
