"""Identification of a MuJoCo model's parameters from trajectories, with confidence intervals."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_gn.checks import check_count, checked_seed
from torchrl_gn.data.simulate import Simulator
from torchrl_gn.dynamics.joint_coordinates import JointCoordinates
from torchrl_gn.scenes.articulation import require_bodies
from torchrl_gn.scenes.checked_trajectories import check_trajectories
from torchrl_gn.scenes.load import as_scene
from torchrl_gn.scenes.scaled import Chosen, find_numbers, scaled_scene, with_inertia
from torchrl_gn.scenes.scene import Scene, UnsupportedSceneError

_DIFFERENCE = 1e-6  # step of one-sided differences, of logarithms and starts
_DAMPING = (1e-2, 1.0, 1e2, 1e4)  # factors on the Levenberg-Marquardt damping that are tried at once
_LARGEST = 1.0  # largest change of a logarithm in one iteration
_LOST = -5.0  # logarithm below which a parameter has hardly any effect, and its logarithm no slope
_FAR = 20.0  # logarithm beyond which the data only bound a parameter, as if commands never move a robot
_CONVERGED = 1e-9  # change of a logarithm below which the search ends
_FIRST = (0.03, 0.1)  # shares of a window's steps that are fitted first
_REWEIGHED = 3  # rounds of fitting and reweighting
_FLAT = 1e-10  # curvature along a direction, relative to those of its parameters, that is rounding of differences
_PART = 1e-3  # component of such a direction that leaves a parameter undetermined
_ROUNDING = 1e-9  # residuals below this share of the motion are rounding errors


@dataclass(frozen=True)
class Identified:
    """Parameters of a model identified from trajectories."""

    names: tuple[str, ...]  # "dof_armature elbow"
    factor: np.ndarray  # [P] factors on the model's numbers
    log_std: np.ndarray  # [P] standard deviation of its logarithm; infinite if the data do not determine the factor
    value: np.ndarray  # [P] first of each parameter's numbers, multiplied by its factor
    error: float  # root mean square of the residuals, relative to the persistence baseline
    model: mujoco.MjModel  # with the identified numbers

    def interval(self, deviations: float = 2.0) -> np.ndarray:
        """Return intervals ``[P, 2]`` of the values, ``deviations`` standard deviations to each side."""
        return self.value[:, None] * np.exp(np.outer(self.log_std, [-deviations, deviations]))

    def __str__(self) -> str:
        low, high = self.interval().T
        rows = zip(self.names, self.value, low, high, strict=True)
        lines = [f"{name:40}{value:12.5g}   {a:.5g} to {b:.5g}" for name, value, a, b in rows]
        return "\n".join([*lines, f"residuals: {self.error:.2g} of the motion"])


def parameter_names(scene: Scene, parameters: Chosen) -> tuple[str, ...]:
    """Return the names of chosen ``parameters``, see :func:`identify_parameters`, such as ``"dof_armature elbow"``."""
    return find_numbers(require_bodies(scene, "parameter_names").model, parameters)[0]


def identify_parameters(
    scene: Scene | str | os.PathLike,
    trajectories: TensorDictBase,
    parameters: Chosen,
    *,
    window: int = 50,
    max_windows: int = 100,
    fit_starts: bool = False,
    iterations: int = 50,
    num_threads: int | None = None,
    seed: int = 0,
) -> Identified:
    """Identify positive parameters of a MuJoCo model from trajectories.

    Levenberg-Marquardt minimises the squared residuals of simulations over windows of the trajectories (multiple
    shooting), in the logarithms of the parameters. Components are weighted by the inverse of their remaining residuals.
    Standard deviations allow for correlated residuals within a window (clusters; Liang and Zeger 1986). The search
    begins with the first steps of each window, as dry friction and contacts make many minima over longer times.

    Args:
        scene: scene whose parameters the search starts from, or its name or path.
        trajectories: ``[M]`` of ``state`` ``[M, T + 1, N, C]``, ``action`` ``[M, T, A]`` and, if known, ``physics``
            ``[M, T + 1, S]``; without it, starts are computed from ``state``. For a log of joint coordinates,
            :meth:`Simulator.observe <torchrl_gn.data.Simulator.observe>` computes the states.
        parameters: names of bodies, joints, geoms, actuators or tendons by array of ``mjModel``, as in
            ``{"dof_armature": ["elbow"], "body_mass": None}``; None: all whose number is not 0. Each gets a factor of
            its own; a factor of ``body_mass`` multiplies the inertia too.
        window: control steps of a simulation. Longer windows reveal smaller effects, but fail if motion is chaotic.
        max_windows: largest number of windows; if there are more, they are drawn at random.
        fit_starts: fit the starts of the windows too. Use it for noisy states, which would bias the parameters
            otherwise, with windows several times as long as the robot has coordinates and rates.

    Raises:
        TypeError: for a :class:`~torchrl_gn.scenes.KinematicTree`, which has no masses.
        UnsupportedSceneError: if starts cannot be computed from the states.
        ValueError: if an array, name, window or count does not fit, or a number is 0; if trajectories are not finite,
            or the times in their ``physics`` show another control step, or their ``parameters`` several robots.
        FloatingPointError: if simulations with the initial parameters are unstable.
    """
    for option, count, least in (("window", window, 1), ("max_windows", max_windows, 1), ("iterations", iterations, 0)):
        check_count(option, count, least)
    scene = require_bodies(as_scene(scene), "identify_parameters")
    names, rows = find_numbers(scene.model, parameters)
    check_trajectories(trajectories, scene, layout=scene.layout)
    _check_one_robot(trajectories)
    rng = np.random.default_rng(checked_seed(seed))
    starts, actions, truth = _windows(scene, trajectories, window, max_windows, rng)
    problem = _Problem(scene, rows, starts, actions, truth, num_threads)
    log, left = problem.begun(np.zeros(len(names)), iterations), problem.moved
    for again in range(_REWEIGHED):
        # Fit starts only after the first round: while the model is far off, fitted starts would be too.
        problem.coordinates = 2 * scene.model.nv if fit_starts and again else 0
        log = problem.found_again(problem.solve(log, iterations), iterations)
        left = problem.weigh(log)
        if (left <= _ROUNDING * problem.moved).all():  # without noise, weights do not matter
            break
    error = float(np.sqrt(np.mean((left / problem.moved) ** 2)))
    model = _changed(scene, rows, np.exp(log)).model
    value = np.array([getattr(model, array)[index].flat[0] for array, index in rows])
    return Identified(names, np.exp(log), problem.deviations(log), value, error, model)


class _Problem:
    """Least-squares problem of simulations over windows.

    ``coordinates`` is the number of start coordinates fitted beside the logarithms: 0, or all with their rates.
    """

    def __init__(self, scene: Scene, rows, starts: np.ndarray, actions: np.ndarray, truth: Tensor, num_threads) -> None:
        self.scene, self.rows, self.starts, self.actions, self.truth = scene, rows, starts, actions, truth
        self.num_threads, self.coordinates, self.steps = num_threads, 0, actions.shape[1]
        self.channels = torch.from_numpy(scene.movable & scene.predicted[:, None])
        sizes = [where.stop - where.start for where in scene.layout.delta_slices.values()]
        component = np.broadcast_to(np.repeat(np.arange(len(sizes)), sizes), self.channels.shape)
        self.component = component[self.channels.numpy()]
        still = scene.layout.delta(truth, truth[:, :1].expand_as(truth))[..., self.channels].numpy()
        self.moved = np.maximum(self._rms(still), 1e-12)
        self.weight = 1 / self.moved

    def residuals(self, logs: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """Return weighted residuals ``[V, W, T + 1, channels]`` for ``logs`` ``[V, P]`` and ``starts`` ``[V, W, S]``.

        Residuals of unstable simulations are infinite.
        """
        variants, count = [_changed(self.scene, self.rows, np.exp(log)) for log in logs], len(self.starts)
        simulated = Simulator(variants, self.num_threads).rollout(
            starts.reshape(-1, starts.shape[-1]),
            np.tile(self.actions[:, : self.steps], (len(logs), 1, 1)),
            np.repeat(np.arange(len(logs)), count),
        )
        state = simulated["state"].unflatten(0, (len(logs), count))
        truth = self.truth[:, : self.steps + 1]
        off = self.scene.layout.delta(truth.expand_as(state), state)[..., self.channels]
        off = torch.where(simulated["stable"].view(len(logs), count, 1, 1), off, torch.inf)
        return off.numpy() * self.weight

    def begun(self, log: np.ndarray, iterations: int) -> np.ndarray:
        """Return start logarithms: those fitted to windows' first steps, if better over whole windows, else ``log``."""
        whole = self.steps
        for share in _FIRST:
            self.steps = max(1, round(share * whole))
            try:
                short = self.solve(log, iterations)
            except FloatingPointError:  # the fit of whole windows reports it
                short = log
            self.steps = whole
            costs = np.square(self.residuals(np.stack((log, short)), np.stack((self.starts,) * 2))).sum((1, 2, 3))
            log = short if costs[1] < costs[0] else log
        return log

    def weigh(self, log: np.ndarray) -> np.ndarray:
        """Weight components by the inverse of their residuals ``[channels]``, and return these."""
        left = self._rms(self.residuals(log[None], self.starts[None])[0] / self.weight)
        # A component with hardly more than rounding errors left must not dominate.
        self.weight = 1 / np.maximum(left, 1e-6 * self.moved)
        return left

    def solve(self, log: np.ndarray, iterations: int) -> np.ndarray:
        """Minimise the squared residuals from ``log`` on; return the logarithms ``[P]``."""
        damping = 1.0
        for _ in range(iterations):
            off, slope, by_start = self._linearized(log)
            cost = float(np.square(off).sum())
            if not np.isfinite(cost):
                raise FloatingPointError("Simulations of the trajectories become unstable: give shorter windows.")
            reduced, reduced_slope = _without(by_start, off), _without(by_start, slope)
            flat = reduced_slope.reshape(-1, len(log))
            curvature, gradient = flat.T @ flat, flat.T @ reduced.ravel()
            tried = damping * np.array(_DAMPING)
            scale = np.diag(np.maximum(curvature.diagonal(), 1e-300))
            steps = np.stack([np.linalg.lstsq(curvature + each * scale, -gradient, rcond=None)[0] for each in tried])
            steps = steps.clip(-_LARGEST, _LARGEST)
            starts = np.stack([self._moved(_nearest(by_start, off + slope @ step)) for step in steps])
            costs = np.square(self.residuals(log + steps, starts)).sum((1, 2, 3))
            costs = np.where(np.isfinite(costs), costs, np.inf)
            best = int(costs.argmin())
            if costs[best] < cost:
                log, self.starts, damping = log + steps[best], starts[best], max(tried[best] / 10, 1e-12)
                if np.abs(steps[best]).max() < _CONVERGED or cost - costs[best] < 1e-9 * cost:
                    break
            elif damping > 1e8:
                break
            else:
                damping *= 1e4
        return log

    def found_again(self, log: np.ndarray, iterations: int) -> np.ndarray:
        """Minimise from ``log`` again, with parameters that went to 0 back at their first numbers, if that fits better.

        Short windows of noisy states can drive parameters to 0, where their logarithms have no slope.
        """
        lost, starts = log < _LOST, self.starts
        if not lost.any():
            return log
        cost = np.square(self.residuals(log[None], starts[None])).sum()
        try:
            again = self.solve(np.where(lost, 0.0, log), iterations)
        except FloatingPointError:
            again = log
        if np.square(self.residuals(again[None], self.starts[None])).sum() < cost:
            return again
        self.starts = starts
        return log

    def deviations(self, log: np.ndarray) -> np.ndarray:
        """Return standard deviations ``[P]`` of the logarithms at the minimum; windows are clusters."""
        off, slope, by_start = self._linearized(log)
        off, slope = _without(by_start, off), _without(by_start, slope)
        windows, count = len(off), len(log)
        flat = slope.reshape(-1, count)
        inverse, known = _inverse(flat.T @ flat)
        # Residuals within a window are correlated. With few windows, each step is a cluster.
        parts = windows if windows > 2 * count else windows * self.truth.shape[1]
        scores = np.einsum("wrp,wr->wp", slope.reshape(parts, -1, count), off.reshape(parts, -1))
        free = max(parts - count - windows * self.coordinates * (parts > windows), 1)
        covariance = inverse @ (scores.T @ scores) @ inverse * parts / free
        determined = known & (np.abs(log) < _FAR)
        return np.where(determined, np.sqrt(np.maximum(covariance.diagonal(), 0)), np.inf)

    def _linearized(self, log: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return residuals ``[W, R]`` and their derivatives by logarithms ``[W, R, P]`` and by starts ``[W, R, Q]``."""
        count, size = len(log), self.coordinates
        logs = np.concatenate((log[None], log + _DIFFERENCE * np.eye(count), np.tile(log, (size, 1))))
        changes = _DIFFERENCE * np.eye(size)[:, None].repeat(len(self.starts), 1)  # [Q, W, Q]
        starts = [self.starts] * (1 + count) + [self._moved(change) for change in changes]
        residuals = self.residuals(logs, np.stack(starts)).reshape(1 + count + size, len(self.starts), -1)
        slopes = np.moveaxis((residuals[1:] - residuals[0]) / _DIFFERENCE, 0, -1)
        return residuals[0], slopes[..., :count], slopes[..., count:]

    def _moved(self, change: np.ndarray) -> np.ndarray:
        """Return starts ``[W, S]`` after changes ``[W, Q]`` of coordinates and rates."""
        if not change.shape[-1]:
            return self.starts
        model, moved = self.scene.model, self.starts.copy()
        places, rates = slice(1, 1 + model.nq), slice(1 + model.nq, 1 + model.nq + model.nv)
        for row, step in zip(moved, change, strict=True):
            position = row[places].copy()
            mujoco.mj_integratePos(model, position, step[: model.nv], 1.0)
            row[places] = position
        moved[:, rates] += change[:, model.nv :]
        return moved

    def _rms(self, values: np.ndarray) -> np.ndarray:
        """Return the root mean square ``[channels]`` of values ``[W, T, channels]``, pooled over each component."""
        squares = np.square(values).mean((0, 1))
        means = np.bincount(self.component, squares) / np.maximum(np.bincount(self.component), 1)
        return np.sqrt(means)[self.component]


def _inverse(curvature: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Invert a curvature ``[P, P]`` where it is not flat; also return the parameters ``[P]``, bool, that it determines.

    The motion may determine only products or ratios of some parameters, such as a motor's gain and gear.
    """
    size = curvature.diagonal()
    acts = size > 1e-12 * max(size.max(), 1e-300)
    unit = np.where(acts, np.sqrt(np.maximum(size, 1e-300)), np.inf)
    values, directions = np.linalg.eigh(curvature / np.outer(unit, unit))
    flat = values < _FLAT
    known = acts & ~(np.abs(directions[:, flat]) > _PART).any(1)
    steep = directions[:, ~flat] / unit[:, None]
    return (steep / values[~flat]) @ steep.T, known


def _nearest(by_start: np.ndarray, off: np.ndarray) -> np.ndarray:
    """Return changes of starts ``[W, Q]`` that minimise residuals ``[W, R]``."""
    if not by_start.shape[-1]:
        return np.zeros((len(off), 0))
    return -(np.linalg.pinv(by_start) @ off[..., None])[..., 0]


def _without(by_start: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Project out of residuals ``[W, R]``, or derivatives ``[W, R, P]``, the part that starts can change."""
    if not by_start.shape[-1]:
        return values
    basis = np.linalg.qr(by_start)[0]
    if values.ndim == 2:
        return values - (basis @ (basis.transpose(0, 2, 1) @ values[..., None]))[..., 0]
    return values - basis @ (basis.transpose(0, 2, 1) @ values)


def _changed(scene: Scene, rows: Sequence[tuple[str, list[int]]], factors: np.ndarray) -> Scene:
    """Return the scene with factors on its model's numbers, for simulation only."""
    return scaled_scene(scene, with_inertia((*row, factor) for row, factor in zip(rows, factors, strict=True)))


def _check_one_robot(trajectories: TensorDictBase) -> None:
    for name, value in trajectories.select("parameters", strict=False).items(True, True):
        if not bool((value == value[:1]).all()):
            raise ValueError(f"The trajectories are of several robots: {name} differ. Identify one at a time.")


def _windows(
    scene: Scene, trajectories: TensorDictBase, window: int, most: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, Tensor]:
    """Cut windows: starts ``[W, S]``, actions ``[W, T, A]`` and states ``[W, T + 1, N, C]``."""
    state, action = (trajectories[key].detach().cpu() for key in ("state", "action"))
    steps = action.shape[1]
    if window > steps:
        raise ValueError(f"window={window} must be from 1 to the trajectories' {steps} steps.")
    places = [(one, first) for one in range(len(action)) for first in range(0, steps - window + 1, window)]
    if len(places) > most:
        places = [places[each] for each in sorted(rng.choice(len(places), most, replace=False))]
    truth = torch.stack([state[one, first : first + window + 1] for one, first in places]).double()
    actions = torch.stack([action[one, first : first + window] for one, first in places]).double().numpy()
    if (known := trajectories.get("physics", None)) is not None:
        starts = torch.stack([known[one, first] for one, first in places]).double().detach().cpu().numpy()
    else:
        starts = _physics(scene, truth[:, 0])
    return starts, actions, truth


def _physics(scene: Scene, state: Tensor) -> np.ndarray:
    """Compute full physics states ``[W, S]`` from body states ``[W, N, C]``."""
    model = scene.model
    if scene.physics_size != 1 + model.nq + model.nv:
        raise UnsupportedSceneError(
            f"The bodies of scene {scene.name!r} do not determine its state: give trajectories with 'physics'."
        )
    position, velocity = (each.numpy() for each in JointCoordinates(scene)(state))
    return np.concatenate((np.zeros((len(state), 1)), position, velocity), axis=1)
