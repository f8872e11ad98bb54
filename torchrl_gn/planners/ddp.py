"""Control-limited differential dynamic programming: backward pass and box-constrained quadratic program.

Tassa, Mansard and Todorov 2014.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_PRECISION = 1e-12
_STEP_SIZES = 0.5 ** np.arange(1, 12)  # line search of the box-constrained program, after the full step


@dataclass(frozen=True)
class QuadraticModel:
    """Quadratic model of a control problem around a trajectory of ``H`` steps.

    Its variables are changes of the state (``X``) and the control (``A``).
    """

    dynamics: np.ndarray  # [H, X, X + A], Jacobian of the next state
    gradient: np.ndarray  # [H, X + A], of each step's cost
    hessian: np.ndarray  # [H, X + A, X + A], of each step's cost, positive semidefinite
    lower: np.ndarray  # [H, A], lower bounds of the controls' changes, at most 0
    upper: np.ndarray  # [H, A], upper bounds, at least 0

    def control_gradient(self) -> np.ndarray:
        """Compute the gradient ``[H, A]`` of the total cost with respect to the controls (adjoint equation)."""
        size = self.dynamics.shape[1]
        costate, gradient = np.zeros(size), np.empty(self.lower.shape)
        for t in reversed(range(len(gradient))):
            total = self.gradient[t] + costate @ self.dynamics[t]
            costate, gradient[t] = total[:size], total[size:]
        return gradient


def backward_pass(
    model: QuadraticModel, control_damping: np.ndarray, state_damping: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the policies that minimise a quadratic model, for ``M`` dampings at once.

    Args:
        control_damping: ``[M]``, added to the diagonal of the controls' Hessian.
        state_damping: ``[M]``, added to the diagonal of the next value's Hessian.

    Returns:
        Control changes ``[H, M, A]`` and feedback gains ``[H, M, A, X]``; gains are zero for controls at bounds.
    """
    steps, size = model.dynamics.shape[:2]
    num, count = model.lower.shape[1], len(control_damping)
    changes, gains = np.empty((steps, count, num)), np.empty((steps, count, num, size))
    value_gradient, value_hessian = np.zeros((count, size)), np.zeros((count, size, size))
    identity, warm_start = np.eye(num), np.zeros((count, num))
    for t in reversed(range(steps)):
        dynamics = model.dynamics[t]
        effect = dynamics[:, size:]
        q = model.gradient[t] + value_gradient @ dynamics
        qq = model.hessian[t] + dynamics.T @ value_hessian @ dynamics
        q_u, q_uu, q_ux = q[:, size:], qq[:, size:, size:], qq[:, size:, :size]
        # Keep the Hessian invertible where controls are redundant or have no effect.
        least = _PRECISION * np.abs(q_uu).max(axis=(1, 2))
        damped_uu = q_uu + np.maximum(control_damping, least)[:, None, None] * identity
        damped_ux = q_ux
        if state_damping.any():
            damped_uu = damped_uu + state_damping[:, None, None] * (effect.T @ effect)
            damped_ux = damped_ux + state_damping[:, None, None] * (effect.T @ dynamics[:, :size])
        change, free = solve_box_qp(damped_uu, q_u, model.lower[t], model.upper[t], warm_start)
        reduced = np.where(free[:, :, None] & free[:, None, :], damped_uu, identity)
        gain = -np.linalg.solve(reduced, np.where(free[..., None], damped_ux, 0.0))
        # The policy is damped, its value is not.
        gain_t = gain.swapaxes(1, 2)
        slope = (gain_t @ q_uu + q_ux.swapaxes(1, 2)) @ change[..., None] + gain_t @ q_u[..., None]
        value_gradient = q[:, :size] + slope[..., 0]
        cross = gain_t @ q_ux
        value_hessian = qq[:, :size, :size] + gain_t @ q_uu @ gain + cross + cross.swapaxes(1, 2)
        value_hessian = 0.5 * (value_hessian + value_hessian.swapaxes(1, 2))
        changes[t], gains[t], warm_start = change, gain, change
    return changes, gains


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
    r"""Solve a batch of box-constrained quadratic programs by projected Newton (section III-B).

    .. math:: \min_x \tfrac12 x^\top H x + g^\top x \quad \text{with} \quad l \le x \le u

    Args:
        hessian: ``[M, n, n]`` symmetric positive definite.
        gradient: ``[M, n]``; the bounds broadcast to it.
        start: warm start ``[M, n]``, clipped to the bounds. Default: 0.
        tolerance: bound on the free gradient, relative to ``|g|``.

    Returns:
        Solutions ``[M, n]``, and a bool mask ``[M, n]`` of the free dimensions, which are not held at a bound.
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
        # If no step size helps, floating-point precision is reached.
        change = np.where((better & unsolved)[:, None], trial - x, 0.0)
        if not change.any():
            return x, free
        x = x + change
    slope = gradient + _times(hessian, x)
    return x, ~(((x <= lower) & (slope > 0)) | ((x >= upper) & (slope < 0)))


def _descends(hessian: np.ndarray, slope: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Check the Armijo condition with factor 0.1; the change of the quadratic cost is exact."""
    predicted = (slope * change).sum(axis=-1)
    return predicted + 0.5 * (change * _times(hessian, change)).sum(axis=-1) <= 0.1 * predicted


def _times(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return (matrix @ vector[..., None])[..., 0]
