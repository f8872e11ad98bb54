"""Control-limited iLQG of one trajectory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from torchrl_gn.planners.ddp import QuadraticModel, backward_pass
from torchrl_gn.planners.linearize import Linearization, RewardExpansion
from torchrl_gn.planners.plant import Paths, Plant

# An iteration simulates these candidates at once: every damping (a multiple of the last successful one) and step size.
_DAMPINGS = np.array([0.0, 0.01, 0.1, 1.0, 10.0])
_STEP_SIZES = np.array([1.0, 0.3])
_DAMPING_RANGE = (1e-4, 1e4)
_FAILURE_FACTOR = 100.0  # factor on the damping if no candidate improves
_MIN_DAMPING = 1e-9  # keeps the quadratic model strictly convex
_STATE_DAMPING = 0.3  # relative to the controls'


# States before, actions, states after, masks of stable and counted steps; the last step replaces those after the end.
CountedSteps = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
Count = Callable[[np.ndarray, np.ndarray, np.ndarray], CountedSteps]  # from bodies, actions and stable, see Paths


@dataclass(frozen=True)
class Trajectory:
    """A sequence of ``H`` control steps."""

    controls: np.ndarray  # [H, A], in units of half their range, -1 to 1
    path: np.ndarray  # [H + 1, S], the plant's states
    state: np.ndarray  # [H + 1, N, 13], body states
    cost: float  # control costs minus rewards until the end, infinite if unstable before the end
    length: int  # steps until the end, at most H


class ILQGSolver:
    """Solver that improves trajectories by iLQG.

    Every iteration linearises the dynamics, expands the reward (Gauss-Newton), solves the control-limited backward pass
    for several dampings, simulates each policy at several step sizes, and accepts the best trajectory if it improves.
    (Tassa et al. adapt one damping between iterations.) Dampings are relative to the cost gradient's root mean square.

    Args:
        control_cost: cost per step of a control at its bound.
        count: function that returns the steps of trajectories until an episode's end; default: all steps count. Later
            controls stay as they are, because nothing depends on them.
    """

    def __init__(self, plant: Plant, reward: RewardExpansion, *, control_cost: float, count: Count | None = None):
        self.plant, self.reward, self.control_cost, self.count = plant, reward, control_cost, count or _all_steps
        self.scene = plant.scene
        self._middle = 0.5 * (self.scene.action_high + self.scene.action_low)
        self._half = 0.5 * (self.scene.action_high - self.scene.action_low)

    def controls(self, actions: np.ndarray) -> np.ndarray:
        """Scale actions to units of half their range, -1 to 1; 0 where they are fixed."""
        off = actions - self._middle
        return np.clip(np.divide(off, self._half, out=np.zeros_like(off), where=self._half > 0), -1.0, 1.0)

    def actions(self, controls: np.ndarray) -> np.ndarray:
        """Scale controls to the actuators' units."""
        actions = self._middle + self._half * controls
        return np.clip(actions, self.scene.action_low, self.scene.action_high)  # rounding

    def follow(self, start: np.ndarray, controls: np.ndarray) -> Trajectory:
        """Follow ``n`` control sequences ``[n, H, A]`` from one state ``[S]``; return the best trajectory."""
        return self._best(controls, self.plant.rollout(start, self.actions(controls)))[0]

    def improve(self, trajectory: Trajectory, iterations: int) -> Trajectory:
        """Improve a stable trajectory; the cost never rises."""
        damping = 1.0
        expanded: tuple[Linearization, QuadraticModel] | None = None  # around the trajectory
        for _ in range(iterations):
            expanded = expanded or self.expand(trajectory)
            local, model = expanded
            scale = np.sqrt(np.square(model.control_gradient()).mean())
            if not (np.isfinite(scale) and np.isfinite(model.hessian).all()) or scale == 0:
                return trajectory  # stationary, or no finite expansion
            candidate, factor = self._best_candidate(trajectory, local, model, damping, scale)
            if candidate.cost < trajectory.cost:
                trajectory, expanded = candidate, None
                damping = float(np.clip(damping * (factor or 1.0), *_DAMPING_RANGE))
            elif damping >= _DAMPING_RANGE[1]:
                return trajectory
            else:
                damping *= _FAILURE_FACTOR
        return trajectory

    def expand(self, trajectory: Trajectory) -> tuple[Linearization, QuadraticModel]:
        """Expand the dynamics to first order and the cost to second order around a trajectory."""
        steps = trajectory.length
        controls_to_end, state = trajectory.controls[:steps], trajectory.state[: steps + 1]
        actions = self.actions(controls_to_end)
        local = self.plant.linearize(trajectory.path[: steps + 1], actions)
        size, num = local.bodies.shape[2], self.scene.num_actions
        dynamics = local.dynamics.copy()
        dynamics[..., size:] *= self._half
        bodies = np.concatenate([local.bodies[:-1], np.zeros((steps, local.bodies.shape[1], num))], axis=2)
        controls = np.zeros((steps, num, size + num))
        controls[:, range(num), range(size, size + num)] = self._half
        jacobians = (bodies, controls, local.bodies[1:] @ dynamics)
        if not (np.isfinite(dynamics).all() and np.isfinite(jacobians[2]).all()):
            gradient = np.full((steps, size + num), np.nan)
            hessian = np.full((steps, size + num, size + num), np.nan)
        else:
            gradient, hessian = self.reward.derivatives((state[:-1], actions, state[1:]), jacobians)
            gradient, hessian = -gradient, _positive(-hessian)
            gradient[:, size:] += 2 * self.control_cost * controls_to_end
            hessian[:, range(size, size + num), range(size, size + num)] += 2 * self.control_cost
        lower, upper = -1.0 - controls_to_end, 1.0 - controls_to_end
        return local, QuadraticModel(dynamics, gradient, hessian, lower, upper)

    def _best_candidate(
        self, trajectory: Trajectory, local: Linearization, model: QuadraticModel, damping: float, scale: float
    ) -> tuple[Trajectory, float]:
        """Return the best trajectory of all dampings and step sizes, and its damping relative to ``damping``."""
        control_damping = scale * np.maximum(damping * _DAMPINGS, _MIN_DAMPING)
        # The mean squared effect of a control on the next state converts the damping to the states' units.
        effect = np.square(model.dynamics[..., model.dynamics.shape[1] :]).sum(axis=1).mean()
        state_damping = _STATE_DAMPING * control_damping / max(effect, np.finfo(np.float64).tiny)
        with np.errstate(all="ignore"):  # lightly damped candidates may overflow: they lose
            changes, gains = backward_pass(model, control_damping, state_damping)
            which = np.repeat(np.arange(len(_DAMPINGS)), len(_STEP_SIZES))
            step = np.tile(_STEP_SIZES, len(_DAMPINGS))[:, None]
            controls = np.empty((len(which), *trajectory.controls.shape))

            def policy(t: int, states: np.ndarray) -> np.ndarray:
                if t >= trajectory.length:
                    controls[:, t] = trajectory.controls[t]
                    return self.actions(controls[:, t])
                feedback = (gains[t, which] @ local.deviation(t, states)[..., None])[..., 0]
                controls[:, t] = np.clip(trajectory.controls[t] + step * changes[t, which] + feedback, -1.0, 1.0)
                return self.actions(controls[:, t])

            paths = self.plant.follow(trajectory.path[0], len(which), len(trajectory.controls), policy)
        best, index = self._best(controls, paths)
        return best, float(_DAMPINGS[which[index]])

    def _best(self, controls: np.ndarray, followed: Paths) -> tuple[Trajectory, int]:
        """Return the cheapest of ``n`` trajectories and its index; unstable or non-finite ones cost infinity."""
        paths, states, stable = followed
        actions = self.actions(controls)
        before, action, after, stable, counted = self.count(states, actions, stable)
        costs = np.full(len(controls), np.inf)
        if (whole := stable.all(axis=1)).any():
            rewards = self.reward.value((before[whole], action[whole], after[whole]))
            efforts = self.control_cost * np.square(controls[whole]).sum(axis=-1)
            costs[whole] = np.where(counted[whole], efforts - rewards, 0.0).sum(axis=-1)
        costs = np.where(np.isfinite(costs), costs, np.inf)
        best = int(costs.argmin())
        length = int(counted[best].sum())
        return Trajectory(controls[best], paths[best], states[best], float(costs[best]), length), best


def _all_steps(bodies: np.ndarray, actions: np.ndarray, stable: np.ndarray) -> CountedSteps:
    return bodies[:, :-1], actions, bodies[:, 1:], stable, np.ones_like(stable)


def _positive(matrices: np.ndarray) -> np.ndarray:
    """Project matrices ``[T, Z, Z]`` onto the nearest positive semidefinite ones."""
    if not (np.isfinite(matrices).all() and matrices.any()):
        return matrices
    values, vectors = np.linalg.eigh(0.5 * (matrices + matrices.swapaxes(1, 2)))
    return (vectors * values.clip(min=0.0)[:, None]) @ vectors.swapaxes(1, 2)
