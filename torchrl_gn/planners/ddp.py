"""Backward pass of control-limited differential dynamic programming (Tassa, Mansard and Todorov 2014)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchrl_gn.planners.box_qp import solve_box_qp

_PRECISION = 1e-12


@dataclass(frozen=True)
class QuadraticModel:
    """A control problem around a trajectory of ``H`` steps, in changes of state (``X``) and control (``A``)."""

    dynamics: np.ndarray  # [H, X, X + A], Jacobian of the next state
    gradient: np.ndarray  # [H, X + A], of each step's cost
    hessian: np.ndarray  # [H, X + A, X + A], of each step's cost, positive semidefinite
    lower: np.ndarray  # [H, A], lower bounds of the controls' changes, at most 0
    upper: np.ndarray  # [H, A], upper bounds, at least 0

    def control_gradient(self) -> np.ndarray:
        """Gradient ``[H, A]`` of the total cost by the controls (adjoint equation)."""
        size = self.dynamics.shape[1]
        costate, gradient = np.zeros(size), np.empty(self.lower.shape)
        for t in reversed(range(len(gradient))):
            total = self.gradient[t] + costate @ self.dynamics[t]
            costate, gradient[t] = total[:size], total[size:]
        return gradient


def backward_pass(
    model: QuadraticModel, control_damping: np.ndarray, state_damping: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Policies that minimise a quadratic model, for ``M`` dampings at once.

    Args:
        control_damping: ``[M]``, added to the diagonal of the controls' Hessian.
        state_damping: ``[M]``, added to the diagonal of the next value's Hessian.

    Returns:
        Control changes ``[H, M, A]`` and feedback gains ``[H, M, A, X]``, zero for controls at bounds.
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
        # Redundant controls, or ones without effect, must not make it singular.
        least = _PRECISION * np.abs(q_uu).max(axis=(1, 2))
        damped_uu = q_uu + np.maximum(control_damping, least)[:, None, None] * identity
        damped_ux = q_ux
        if state_damping.any():
            damped_uu = damped_uu + state_damping[:, None, None] * (effect.T @ effect)
            damped_ux = damped_ux + state_damping[:, None, None] * (effect.T @ dynamics[:, :size])
        change, free = solve_box_qp(damped_uu, q_u, model.lower[t], model.upper[t], warm_start)
        reduced = np.where(free[:, :, None] & free[:, None, :], damped_uu, identity)
        gain = -np.linalg.solve(reduced, np.where(free[..., None], damped_ux, 0.0))
        # The policy's value is undamped.
        gain_t = gain.swapaxes(1, 2)
        slope = (gain_t @ q_uu + q_ux.swapaxes(1, 2)) @ change[..., None] + gain_t @ q_u[..., None]
        value_gradient = q[:, :size] + slope[..., 0]
        cross = gain_t @ q_ux
        value_hessian = qq[:, :size, :size] + gain_t @ q_uu @ gain + cross + cross.swapaxes(1, 2)
        value_hessian = 0.5 * (value_hessian + value_hessian.swapaxes(1, 2))
        changes[t], gains[t], warm_start = change, gain, change
    return changes, gains
