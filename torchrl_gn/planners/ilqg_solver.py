"""One trajectory, improved by control-limited iLQG on the true physics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
from torch import Tensor

from torchrl_gn.data.simulate import Simulator
from torchrl_gn.planners.ddp import QuadraticModel, backward_pass
from torchrl_gn.planners.linearize import Tangent, linearize
from torchrl_gn.planners.reward_expansion import RewardExpansion

# Candidates of an iteration, all simulated at once: dampings, as multiples of the last one that did, times step sizes.
_DAMPINGS = np.array([0.0, 0.01, 0.1, 1.0, 10.0])
_STEP_SIZES = np.array([1.0, 0.3])
_DAMPING_RANGE = (1e-4, 1e4)
_AFTER_FAILURE = 100.0  # times more damping where no candidate was better
_LEAST_DAMPING = 1e-9  # keeps the quadratic model strictly convex
_STATE_SHARE = 0.3  # of the damping that the states get


@dataclass(frozen=True)
class Trajectory:
    """A simulated sequence of ``H`` controls, in units of half their range around its middle: -1 to 1.

    Attributes:
        controls: ``[H, A]``.
        physics: ``[H + 1, S]`` MuJoCo states.
        state: ``[H + 1, N, 13]`` body states.
        cost: control costs less rewards, infinite where the simulation was unstable.
    """

    controls: np.ndarray
    physics: np.ndarray
    state: np.ndarray
    cost: float


class ILQGSolver:
    """Improve trajectories from given states.

    Every iteration linearizes the dynamics by finite differences and takes the reward's gradient and
    its curvature in the body states (Gauss-Newton: not that of the dynamics or the kinematics). The
    policies of several dampings follow by the backward pass with box constraints; each is simulated,
    with its feedback, at several step sizes, and the best trajectory is kept if it is better.

    Tassa et al. change one damping after each iteration and only search step sizes. Trying a range of
    dampings at once costs as much simulation and needs no iterations to find the one that does, which
    matters where a control step has time for few. The damping is in units of the problem: of the root
    mean square of the cost's gradient by the controls.

    Args:
        simulator: simulation of one scene, all of whose actions are limited.
        reward: the reward.
        control_cost: cost of a control at its bound, half a range from the middle; quadratic.
        central: differentiate the dynamics by central differences.
    """

    def __init__(self, simulator: Simulator, reward: RewardExpansion, *, control_cost: float, central: bool):
        self.simulator, self.reward = simulator, reward
        self.control_cost, self.central = control_cost, central
        self.scene = simulator.scene
        self.tangent = Tangent(self.scene.model)
        self._middle = 0.5 * (self.scene.action_high + self.scene.action_low)
        self._half = 0.5 * (self.scene.action_high - self.scene.action_low)

    def controls(self, actions: np.ndarray) -> np.ndarray:
        """Controls in units of half their range, from -1 to 1, of actions in the actuators' units; 0 where fixed."""
        off = actions - self._middle
        return np.clip(np.divide(off, self._half, out=np.zeros_like(off), where=self._half > 0), -1.0, 1.0)

    def actions(self, controls: np.ndarray) -> np.ndarray:
        """Actions in the actuators' units."""
        actions = self._middle + self._half * controls
        return np.clip(actions, self.scene.action_low, self.scene.action_high)  # against rounding

    def simulate(self, physics: np.ndarray, controls: np.ndarray) -> Trajectory:
        """The best of ``n`` sequences ``[n, H, A]`` of controls from one state ``[S]``."""
        simulated = self.simulator.rollout(np.tile(physics, (len(controls), 1)), self.actions(controls))
        paths, states, stable = (cast(Tensor, simulated[key]).numpy() for key in ("physics", "state", "stable"))
        return self._best(controls, paths, states, stable)[0]

    def improve(self, trajectory: Trajectory, iterations: int) -> Trajectory:
        """A trajectory that is at least as good as a stable one."""
        damping = 1.0
        for _ in range(iterations):
            model = self.expand(trajectory)
            scale = np.sqrt(np.square(model.control_gradient()).mean())
            if not (np.isfinite(scale) and np.isfinite(model.hessian).all()) or scale == 0:
                return trajectory  # nowhere to go, or no telling where
            candidates, used = self._candidates(trajectory, model, damping, scale)
            if candidates.cost < trajectory.cost:
                trajectory = candidates
                damping = float(np.clip(damping * (used or 1.0), *_DAMPING_RANGE))
            elif damping >= _DAMPING_RANGE[1]:
                return trajectory
            else:
                damping *= _AFTER_FAILURE
        return trajectory

    def expand(self, trajectory: Trajectory) -> QuadraticModel:
        """The cost around a trajectory, to second order."""
        size, steps = self.tangent.size, len(trajectory.controls)
        num = self.scene.num_actions
        actions, state = self.actions(trajectory.controls), trajectory.state
        local = linearize(self.simulator, trajectory.physics, actions, central=self.central)
        dynamics = local.dynamics.copy()
        dynamics[..., size:] *= self._half
        bodies = np.concatenate([local.bodies[:-1], np.zeros((steps, local.bodies.shape[1], num))], axis=2)
        own = np.zeros((steps, num, size + num))
        own[:, range(num), range(size, size + num)] = self._half
        jacobians = (bodies, own, local.bodies[1:] @ dynamics)
        if not (np.isfinite(dynamics).all() and np.isfinite(jacobians[2]).all()):
            gradient = np.full((steps, size + num), np.nan)
            hessian = np.full((steps, size + num, size + num), np.nan)
        else:
            gradient, hessian = self.reward.derivatives((state[:-1], actions, state[1:]), jacobians)
            gradient, hessian = -gradient, _positive(-hessian)
            gradient[:, size:] += 2 * self.control_cost * trajectory.controls
            hessian[:, range(size, size + num), range(size, size + num)] += 2 * self.control_cost
        lower, upper = -1.0 - trajectory.controls, 1.0 - trajectory.controls
        return QuadraticModel(dynamics, gradient, hessian, lower, upper)

    def _candidates(
        self, trajectory: Trajectory, model: QuadraticModel, damping: float, scale: float
    ) -> tuple[Trajectory, float]:
        """The best trajectory of all dampings and step sizes, and its damping over the given one."""
        control_damping = scale * np.maximum(damping * _DAMPINGS, _LEAST_DAMPING)
        # In the units of the states: as much as a control's damping does, by what a control does to the next state.
        effect = np.square(model.dynamics[..., self.tangent.size :]).sum(axis=1).mean()
        state_damping = _STATE_SHARE * control_damping / max(effect, np.finfo(np.float64).tiny)
        with np.errstate(all="ignore"):  # the least damped may overflow: they lose
            changes, gains = backward_pass(model, control_damping, state_damping)
            which = np.repeat(np.arange(len(_DAMPINGS)), len(_STEP_SIZES))
            step = np.tile(_STEP_SIZES, len(_DAMPINGS))[:, None]

            def policy(t: int, physics: np.ndarray) -> np.ndarray:
                off = self.tangent.subtract(physics, trajectory.physics[t])
                feedback = (gains[t, which] @ off[..., None])[..., 0]
                return np.clip(trajectory.controls[t] + step * changes[t, which] + feedback, -1.0, 1.0)

            results = self._follow(trajectory.physics[0], policy, len(which), len(trajectory.controls))
        best, index = self._best(*results)
        return best, float(_DAMPINGS[which[index]])

    def _follow(
        self, physics: np.ndarray, policy: Callable[[int, np.ndarray], np.ndarray], count: int, steps: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Simulate ``count`` copies of a state under a policy: controls, MuJoCo states, body states, whether stable."""
        controls = np.empty((count, steps, self.scene.num_actions))
        paths = np.empty((count, steps + 1, len(physics)))
        states = np.empty((count, steps + 1, self.scene.num_nodes, 13))
        paths[:, 0] = physics
        for t in range(steps):
            controls[:, t] = policy(t, paths[:, t])
            paths[:, t + 1], states[:, t] = self.simulator.step(paths[:, t], self.actions(controls[:, t]))
        # One step more shows the last state, and whether it can be simulated on from.
        beyond, states[:, steps] = self.simulator.step(paths[:, steps], self.actions(controls[:, -1]))
        stable = np.array(
            [np.isfinite(path).all() and np.isfinite(last).all() for path, last in zip(paths, beyond, strict=True)]
        )
        return controls, paths, states, stable

    def _best(
        self, controls: np.ndarray, paths: np.ndarray, states: np.ndarray, stable: np.ndarray
    ) -> tuple[Trajectory, int]:
        """The cheapest of ``n`` trajectories and its index; costs are infinite where unstable or without a reward."""
        costs = np.full(len(controls), np.inf)
        if stable.any():
            seen, used = states[stable], controls[stable]
            rewards = self.reward.value((seen[:, :-1], self.actions(used), seen[:, 1:]))
            costs[stable] = (self.control_cost * np.square(used).sum(axis=-1) - rewards).sum(axis=-1)
        costs = np.where(np.isfinite(costs), costs, np.inf)
        best = int(costs.argmin())
        return Trajectory(controls[best], paths[best], states[best], float(costs[best])), best


def _positive(matrices: np.ndarray) -> np.ndarray:
    """The nearest positive semidefinite matrices to ``[T, Z, Z]``."""
    if not (np.isfinite(matrices).all() and matrices.any()):
        return matrices
    values, vectors = np.linalg.eigh(0.5 * (matrices + matrices.swapaxes(1, 2)))
    return (vectors * values.clip(min=0.0)[:, None]) @ vectors.swapaxes(1, 2)
