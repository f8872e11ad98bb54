"""Random targets of servos on splines: positions around the current ones, velocities that reverse."""

from __future__ import annotations

import math

import numpy as np

from torchrl_gn.data.controls import evaluate_cubics

_LATEST_REVERSAL = 4.0  # longest time between reversals of velocity targets, in knot intervals


def velocity_targets(
    low: np.ndarray, high: np.ndarray, n: int, steps: int, knot_interval: float, rng: np.random.Generator
) -> np.ndarray:
    """Draw targets ``[n, T, A]`` through knots of alternating sign, 1 to 4 ``knot_interval`` apart."""
    from scipy.interpolate import CubicSpline  # imported here, as that takes a second

    knots, size = math.ceil((steps - 1) / knot_interval) + 3, (n, len(low))
    sign = (-1.0) ** (np.arange(knots)[:, None, None] + rng.integers(2, size=size))
    values = rng.uniform(0.0, 1.0, (knots, *size)) * np.where(sign > 0, high, low)
    spline = CubicSpline(np.arange(knots), values, bc_type="natural")
    interval = knot_interval * _LATEST_REVERSAL ** rng.uniform(0.0, 1.0, size)[:, None]
    time = rng.uniform(0.0, 1.0, size)[:, None] + np.arange(steps)[:, None] / interval
    return np.clip(evaluate_cubics(spline.c, time), low, high)


def position_targets(
    start: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    width: np.ndarray,
    fastest: np.ndarray,
    steps: int,
    knot_interval: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Draw targets ``[n, T, A]`` that start at ``start`` ``[n, A]`` and stay within a random interval around it.

    ``width`` ``[n, A]`` is the interval's width as a share of the range from ``low`` to ``high``, each ``[A]`` or
    ``[n, A]``. Targets change by at most ``fastest`` ``[n, A]`` per step.
    """
    from scipy.interpolate import CubicSpline  # imported here, as that takes a second

    start, width = np.clip(start, low, high), (high - low) * width
    first = np.clip(start - rng.uniform(0.0, 1.0, start.shape) * width, low, high - width)
    knots = math.ceil((steps - 1) / knot_interval) + 2
    values = first + width * rng.uniform(0.0, 1.0, (knots, *start.shape))
    values[0] = start
    spline = CubicSpline(np.arange(knots), values, bc_type="clamped")  # at rest at both ends
    interval = np.maximum(knot_interval, _peak_slope(spline.c) / fastest)
    time = np.arange(steps)[:, None] / interval[:, None]
    return np.clip(evaluate_cubics(spline.c, time), low[..., None, :], high[..., None, :])


def _peak_slope(coefficients: np.ndarray) -> np.ndarray:
    """Return the largest slope ``[n, A]`` of cubics ``[4, K - 1, n, A]`` on their unit intervals."""
    a, b, c, _ = coefficients
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = np.clip(np.nan_to_num(-b / (3 * a)), 0.0, 1.0)
    slopes = [(3 * a * x + 2 * b) * x + c for x in (0.0, 1.0, turn)]
    return np.abs(slopes).max(axis=(0, 1))
