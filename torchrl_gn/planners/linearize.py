"""Derivatives of the true physics along a trajectory, by finite differences of whole control steps."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_gn.data.simulate import Simulator


class Tangent:
    """Small changes of a MuJoCo state: ``X = 2 nv + na`` numbers, of positions, velocities and activations.

    Where positions hold quaternions, changes movable in their tangent space (``mj_integratePos``).

    Args:
        model: MuJoCo model of the states.
    """

    def __init__(self, model: mujoco.MjModel):
        self.model = model
        self.size = 2 * model.nv + model.na
        self._flat = model.nq == model.nv
        self._end = 1 + model.nq + model.nv + model.na  # after the time

    def add(self, physics: np.ndarray, change: np.ndarray) -> np.ndarray:
        """States ``[*B, S]`` changed by ``[*B, X]``."""
        nq, nv = self.model.nq, self.model.nv
        changed = np.array(np.broadcast_to(physics, (*change.shape[:-1], physics.shape[-1])), order="C")
        if self._flat:
            changed[..., 1 : self._end] += change
            return changed
        changed[..., 1 + nq : self._end] += change[..., nv:]
        rows = changed.reshape(-1, changed.shape[-1])
        for row, step in zip(rows, change[..., :nv].reshape(-1, nv), strict=True):
            mujoco.mj_integratePos(self.model, row[1 : 1 + nq], step, 1.0)
        return changed

    def subtract(self, physics: np.ndarray, base: np.ndarray) -> np.ndarray:
        """Changes ``[*B, X]`` that lead from states ``base`` to states ``physics``, which broadcast."""
        nq, nv = self.model.nq, self.model.nv
        if self._flat:
            return physics[..., 1 : self._end] - base[..., 1 : self._end]
        physics, base = np.broadcast_arrays(physics, base)
        change = np.empty((*physics.shape[:-1], self.size))
        change[..., nv:] = physics[..., 1 + nq : self._end] - base[..., 1 + nq : self._end]
        to, start = (np.ascontiguousarray(s[..., 1 : 1 + nq]).reshape(-1, nq) for s in (physics, base))
        step = np.empty((len(to), nv))
        for row in range(len(to)):
            mujoco.mj_differentiatePos(self.model, step[row], 1.0, start[row], to[row])
        change[..., :nv] = step.reshape(*change.shape[:-1], nv)
        return change


@dataclass(frozen=True)
class Linearization:
    """Derivatives along a trajectory of ``T`` control steps, NaN where a simulation was unstable.

    Attributes:
        dynamics: ``[T, X, X + A]`` of the next state by state and action.
        bodies: ``[T + 1, N * 13, X]`` of the body states (as ``state``) by the state at the same time.
    """

    dynamics: np.ndarray
    bodies: np.ndarray


def linearize(
    simulator: Simulator,
    physics: np.ndarray,
    actions: np.ndarray,
    *,
    epsilon: float = 1e-6,
    central: bool = False,
) -> Linearization:
    """Differentiate a trajectory: all its steps, perturbed every way, are simulated as one batch.

    Whole control steps are differenced, with all their physics steps, so any integrator and
    contacts are covered. At the bounds controls are perturbed inwards only.

    Args:
        simulator: the simulation, of one scene.
        physics: ``[T + 1, S]`` float64 states of the trajectory.
        actions: ``[T, A]`` its actions, within the bounds.
        epsilon: size of the perturbations, in metres, radians and their rates, and in half the range of a control.
        central: difference to both sides, with an error of the order of ``epsilon ** 2``, rather than to one
            side, at half the cost and an error of the order of ``epsilon``.

    Returns:
        The derivatives, float64.
    """
    scene, tangent = simulator.scene, Tangent(simulator.scene.model)
    times, num = len(physics), tangent.size + scene.num_actions
    # The last state has no action: its row only serves to observe its bodies.
    controls = np.concatenate([actions, actions[-1:]])
    moved = np.zeros((times, num, tangent.size))
    moved[:, range(tangent.size), range(tangent.size)] = epsilon
    above, below, width = _perturb_controls(scene.action_low, scene.action_high, controls, epsilon, central)
    widths = np.full((times, num), 2 * epsilon if central else epsilon)
    widths[:, tangent.size :] = width

    starts = [tangent.add(physics[:, None], moved)]
    held = [_one_changed(controls, tangent.size, above)]
    if central:
        starts.append(tangent.add(physics[:, None], -moved))
        held.append(_one_changed(controls, tangent.size, below))
    else:
        starts.append(physics[:, None])
        held.append(controls[:, None])
    sizes = [times * s.shape[1] for s in starts]
    start = np.concatenate([s.reshape(-1, scene.physics_size) for s in starts])
    held_flat = np.concatenate([h.reshape(-1, scene.num_actions) for h in held])
    after, state = simulator.step(start, held_flat)
    (after_plus, after_minus), (bodies_plus, bodies_minus) = (
        [part.reshape(times, -1, part.shape[-1]) for part in np.split(values, sizes[:1])]
        for values in (after, state.reshape(len(state), -1))
    )
    dynamics = tangent.subtract(after_plus[:-1], after_minus[:-1]) / widths[:-1, :, None]
    minus = bodies_minus[:, : tangent.size]
    seen = (bodies_plus[:, : tangent.size] - minus) / widths[:, : tangent.size, None]
    return Linearization(dynamics.swapaxes(1, 2), seen.swapaxes(1, 2))


def _perturb_controls(
    low: np.ndarray, high: np.ndarray, controls: np.ndarray, epsilon: float, central: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Controls ``[T, A]`` moved up, moved down, and what lies between; from a bound inwards only.

    What lies between is 1 where the bounds are equal: a fixed control changes nothing, and that over 1 is 0.
    """
    step = 0.5 * epsilon * (high - low)
    above = np.minimum(controls + step, high)
    below = np.maximum(controls - step, low)
    if not central:
        above = np.where(controls + step <= high, controls + step, controls - step)
        below = controls
    return above, below, np.where(high > low, above - below, 1.0)


def _one_changed(controls: np.ndarray, before: int, changed: np.ndarray) -> np.ndarray:
    """Controls ``[T, before + A, A]``: as they are ``before`` times, then with one after the other changed."""
    times, num = controls.shape
    result = np.repeat(controls[:, None], before + num, axis=1)
    result[:, range(before, before + num), range(num)] = changed
    return result
