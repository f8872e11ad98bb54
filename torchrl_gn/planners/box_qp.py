"""Batched box-constrained quadratic programs: the controls of one time step."""

from __future__ import annotations

import numpy as np

_STEP_SIZES = 0.5 ** np.arange(1, 12)  # of the line search, after the full step


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
    r"""Solve a batch of problems by projected Newton (Tassa, Mansard and Todorov 2014, section III-B).

    .. math:: \min_x \tfrac12 x^\top H x + g^\top x \quad \text{with} \quad l \le x \le u

    Args:
        hessian: ``[M, n, n]`` symmetric positive definite.
        gradient: ``[M, n]``.
        lower: ``[M, n]``, or broadcastable.
        upper: likewise, not below ``lower``.
        start: warm start ``[M, n]``, clipped to the bounds. Default: 0.
        tolerance: bound on the free gradient, relative to ``|g|``.

    Returns:
        Solutions ``[M, n]`` and the free dimensions ``[M, n]`` bool, those not held at a bound.
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
        trial = np.clip(x + newton, lower, upper)
        if not (better := _descends(hessian, slope, trial - x)).all():
            for step in _STEP_SIZES:
                shorter = np.clip(x + step * newton, lower, upper)
                trial = np.where(better[:, None], trial, shorter)
                better |= _descends(hessian, slope, trial - x)
                if better.all():
                    break
        # Where no step size helps, floating-point precision is reached.
        change = np.where((better & unsolved)[:, None], trial - x, 0.0)
        if not change.any():
            return x, free
        x = x + change
    slope = gradient + _times(hessian, x)
    return x, ~(((x <= lower) & (slope > 0)) | ((x >= upper) & (slope < 0)))


def _descends(hessian: np.ndarray, slope: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Armijo condition with factor 0.1; the quadratic cost's change is exact."""
    predicted = (slope * change).sum(axis=-1)
    return predicted + 0.5 * (change * _times(hessian, change)).sum(axis=-1) <= 0.1 * predicted


def _times(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return (matrix @ vector[..., None])[..., 0]
