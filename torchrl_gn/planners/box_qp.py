"""Small quadratic programs with bounds, many at once: the controls of one time step."""

from __future__ import annotations

import numpy as np

_STEPS = 0.5 ** np.arange(1, 12)  # tried where the full step does not do


def solve_box_qp(
    hessian: np.ndarray,
    gradient: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    start: np.ndarray | None = None,
    *,
    iterations: int = 30,
    tolerance: float = 1e-10,
) -> tuple[np.ndarray, np.ndarray]:
    r"""Projected Newton (Tassa, Mansard and Todorov 2014, section III-B) for a batch of problems.

    .. math:: \min_x \tfrac12 x^\top H x + g^\top x \quad \text{with} \quad l \le x \le u

    A dimension is clamped where it is at a bound that its gradient pushes it against. A Newton
    step in the others is projected on the box and shortened until the cost falls enough.

    Args:
        hessian: ``[M, n, n]`` symmetric positive definite.
        gradient: ``[M, n]``.
        lower: ``[M, n]``, or what broadcasts to it.
        upper: likewise, not below ``lower``.
        start: ``[M, n]`` first guess, clipped to the bounds; the better, the fewer iterations. Default: 0.
        iterations: Newton steps at most.
        tolerance: a problem is solved where its free gradient is this much smaller than ``|g|``.

    Returns:
        Solutions ``[M, n]`` and which of their dimensions are free ``[M, n]`` bool.
    """
    x = np.clip(np.zeros_like(gradient) if start is None else start, lower, upper)
    identity = np.eye(gradient.shape[-1])
    small = tolerance * np.abs(gradient).max(axis=-1) + np.finfo(np.float64).tiny
    for _ in range(iterations):
        slope = gradient + _times(hessian, x)
        free = ~(((x <= lower) & (slope > 0)) | ((x >= upper) & (slope < 0)))
        slope = np.where(free, slope, 0.0)
        unsolved = np.abs(slope).max(axis=-1) > small
        if not unsolved.any():
            return x, free
        reduced = np.where(free[:, :, None] & free[:, None, :], hessian, identity)
        newton = -np.linalg.solve(reduced, slope[..., None])[..., 0]
        moved = np.clip(x + newton, lower, upper)
        if not (better := _descends(hessian, slope, moved - x)).all():
            for step in _STEPS:
                shorter = np.clip(x + step * newton, lower, upper)
                moved = np.where(better[:, None], moved, shorter)
                better |= _descends(hessian, slope, moved - x)
                if better.all():
                    break
        # What no step improves is solved as well as the numbers' precision allows.
        change = np.where((better & unsolved)[:, None], moved - x, 0.0)
        if not change.any():
            return x, free
        x = x + change
    slope = gradient + _times(hessian, x)
    return x, ~(((x <= lower) & (slope > 0)) | ((x >= upper) & (slope < 0)))


def _descends(hessian: np.ndarray, slope: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Whether the cost falls by a tenth of what its slope promises (Armijo); the cost's change is exact here."""
    promised = (slope * change).sum(axis=-1)
    return promised + 0.5 * (change * _times(hessian, change)).sum(axis=-1) <= 0.1 * promised


def _times(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return (matrix @ vector[..., None])[..., 0]
