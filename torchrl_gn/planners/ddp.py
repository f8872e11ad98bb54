"""Backward pass of control-limited differential dynamic programming (Tassa, Mansard and Todorov 2014)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchrl_gn.planners.box_qp import solve_box_qp

_PRECISION = 1e-12


@dataclass(frozen=True)
class QuadraticModel:
    """A control problem near a trajectory of ``H`` steps, in changes of state (``X``) and control (``A``).

    Attributes:
        dynamics: ``[H, X, X + A]`` derivatives of the next state.
        gradient: ``[H, X + A]`` of each step's cost.
        hessian: ``[H, X + A, X + A]`` of each step's cost, positive semidefinite.
        lower: ``[H, A]`` lowest change of the controls, not above 0.
        upper: ``[H, A]`` highest change, not below 0.
    """

    dynamics: np.ndarray
    gradient: np.ndarray
    hessian: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    def control_gradient(self) -> np.ndarray:
        """Gradient ``[H, A]`` of the whole cost by the controls (adjoint equation)."""
        size = self.dynamics.shape[1]
        costate, gradient = np.zeros(size), np.empty(self.lower.shape)
        for t in reversed(range(len(gradient))):
            total = self.gradient[t] + costate @ self.dynamics[t]
            costate, gradient[t] = total[:size], total[size:]
        return gradient


def backward_pass(
    model: QuadraticModel, control_damping: np.ndarray, state_damping: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Policies that minimise a quadratic model, one for each of ``M`` dampings, all at once.

    Args:
        model: the control problem.
        control_damping: ``[M]`` added to the cost's curvature in every control.
        state_damping: ``[M]`` added to the next step's value's curvature in every state, so that the next
            trajectory keeps near the last one.

    Returns:
        Changes of the controls ``[H, M, A]`` and feedback gains ``[H, M, A, X]``, zero for controls at bounds.
    """
    steps, size = model.dynamics.shape[:2]
    num, count = model.lower.shape[1], len(control_damping)
    changes, gains = np.empty((steps, count, num)), np.empty((steps, count, num, size))
    slope, curvature = np.zeros((count, size)), np.zeros((count, size, size))
    identity, guess = np.eye(num), np.zeros((count, num))
    for t in reversed(range(steps)):
        dynamics = model.dynamics[t]
        effect = dynamics[:, size:]
        q = model.gradient[t] + slope @ dynamics
        qq = model.hessian[t] + dynamics.T @ curvature @ dynamics
        q_u, q_uu, q_ux = q[:, size:], qq[:, size:, size:], qq[:, size:, :size]
        # Controls that do the same, or nothing, must not make it singular.
        least = _PRECISION * np.abs(q_uu).max(axis=(1, 2))
        damped_uu = q_uu + np.maximum(control_damping, least)[:, None, None] * identity
        damped_ux = q_ux
        if state_damping.any():
            damped_uu = damped_uu + state_damping[:, None, None] * (effect.T @ effect)
            damped_ux = damped_ux + state_damping[:, None, None] * (effect.T @ dynamics[:, :size])
        change, free = solve_box_qp(damped_uu, q_u, model.lower[t], model.upper[t], guess)
        reduced = np.where(free[:, :, None] & free[:, None, :], damped_uu, identity)
        gain = -np.linalg.solve(reduced, np.where(free[..., None], damped_ux, 0.0))
        # Both in the value of what is done, undamped.
        back = gain.swapaxes(1, 2)
        push = back @ q_uu + q_ux.swapaxes(1, 2)
        slope = q[:, :size] + (push @ change[..., None] + back @ q_u[..., None])[..., 0]
        cross = back @ q_ux
        curvature = qq[:, :size, :size] + back @ q_uu @ gain + cross + cross.swapaxes(1, 2)
        curvature = 0.5 * (curvature + curvature.swapaxes(1, 2))
        changes[t], gains[t], guess = change, gain, change
    return changes, gains
