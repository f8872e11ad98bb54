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
from torchrl_gn.scenes.scaled import DELAY, Chosen, find_numbers, scaled_scene, with_inertia
from torchrl_gn.scenes.scene import Scene, UnsupportedSceneError

_DIFFERENCE = 1e-6  # step of one-sided differences, of coordinates of the search and of starts
_DAMPING = (1e-2, 1.0, 1e2, 1e4)  # factors on the Levenberg-Marquardt damping that are tried at once
_LARGEST = 1.0  # largest change of a coordinate in one iteration
_LOST = -5.0  # logarithm below which a parameter has hardly any effect, and its logarithm no slope
_FAR = 20.0  # logarithm beyond which the data only bound a parameter, as if commands never move a robot
_CONVERGED = 1e-9  # change of coordinates below which the search ends
_FIRST = (0.03, 0.1)  # shares of a window's steps that are fitted first
_FIRST_DELAYS = 8  # at most so many delays begin the search, as far from the true one random commands tell no direction
_FIRST_ITERATIONS = 10  # of each of these
_REWEIGHED = 3  # rounds of fitting and reweighting
_FLAT = 1e-10  # curvature along a direction, relative to those of its parameters, that is rounding of differences
_PART = 1e-3  # component of such a direction that leaves a parameter undetermined
_STILL = 1e-12  # motion of a component (m, rad, m/s, rad/s) that is none
_ROUNDING = 1e-9  # residuals below this share of the motion are rounding errors


@dataclass(frozen=True)
class Identified:
    """Parameters of a model identified from trajectories."""

    names: tuple[str, ...]  # "dof_armature elbow"
    factor: np.ndarray  # [P] factors on the model's numbers; NaN for delays
    # [P] standard deviation of the logarithm of a number, and of a delay in seconds; infinite if the data do not
    # determine it
    std: np.ndarray
    value: np.ndarray  # [P] first of each parameter's numbers, multiplied by its factor; delays in seconds
    error: float  # root mean square of the residuals, relative to the persistence baseline
    model: mujoco.MjModel  # with the identified numbers; without delays, whose buffers belong to the compiled file

    def interval(self, deviations: float = 2.0) -> np.ndarray:
        """Return intervals ``[P, 2]`` of the values, ``deviations`` standard deviations to each side."""
        sides = np.outer(self.std, [-deviations, deviations])
        value, delay = self.value[:, None], np.isnan(self.factor)[:, None]
        return np.where(delay, np.maximum(value + sides, 0.0), value * np.exp(np.where(delay, 0.0, sides)))

    def __str__(self) -> str:
        low, high = self.interval().T
        rows = zip(self.names, self.value, low, high, strict=True)
        lines = [f"{name:40}{value:12.5g}   {a:.5g} to {b:.5g}" for name, value, a, b in rows]
        return "\n".join([*lines, f"residuals: {self.error:.2g} of the motion"])


def parameter_names(scene: Scene, parameters: Chosen) -> tuple[str, ...]:
    """Return the names of chosen ``parameters``, see :func:`identify_parameters`, such as ``"dof_armature elbow"``."""
    return find_numbers(require_bodies(scene, "parameter_names").model, parameters, delays=True)[0]


def identify_parameters(
    scene: Scene | str | os.PathLike,
    trajectories: TensorDictBase,
    parameters: Chosen,
    *,
    window: int = 50,
    max_windows: int = 100,
    max_delay: float = 0.1,
    fit_starts: bool = False,
    iterations: int = 50,
    num_threads: int | None = None,
    seed: int = 0,
) -> Identified:
    """Identify positive parameters of a MuJoCo model, and delays of its actuators, from trajectories.

    Levenberg-Marquardt minimises the squared residuals of simulations over windows of the trajectories (multiple
    shooting), in the logarithms of the parameters and in the delays. Components are weighted by the inverse of their
    remaining residuals. Standard deviations allow for correlated residuals within a window (clusters; Liang and Zeger
    1986). The search begins with the first steps of each window, as dry friction and contacts make many minima over
    longer times, and at several delays.

    A delay is any number of seconds. A command that changes within a physics step acts as its mean over the step: so
    MuJoCo simulates actuators with that ``delay`` and ``interp="linear"``. A delay of all measurements looks like one
    of all commands: their sum is found.

    Args:
        scene: scene whose parameters the search starts from, or its name or path.
        trajectories: ``[M]`` of ``state`` ``[M, T + 1, N, C]``, ``action`` ``[M, T, A]`` and, if known, ``physics``
            ``[M, T + 1, S]``; without it, starts are computed from ``state``. For a log of joint coordinates,
            :meth:`Simulator.observe <torchrl_gn.data.Simulator.observe>` computes the states.
        parameters: names of bodies, joints, geoms, actuators or tendons by array of ``mjModel``, as in
            ``{"dof_armature": ["elbow"], "body_mass": None}``; None: all whose number is not 0. Each gets a factor of
            its own, names in a tuple share one; a factor of ``body_mass`` multiplies the inertia too.
            ``actuator_delay`` takes any actuator, though the model have no delay: ``{"actuator_delay": None}`` finds a
            delay of each, ``{"actuator_delay": [scene.actuator_names]}`` one of all commands.
        window: control steps of a simulation. Longer windows reveal smaller effects, but fail if motion is chaotic.
        max_windows: largest number of windows; if there are more, they are drawn at random.
        max_delay: largest delay, seconds, where delays are identified. Windows begin that long after the start of their
            trajectory, because earlier commands are unknown. A delay at this bound has an infinite standard deviation.
        fit_starts: fit the starts of the windows too. Use it for noisy states, which would bias the parameters
            otherwise, with windows several times as long as the robot has coordinates and rates.

    Raises:
        TypeError: for a :class:`~torchrl_gn.scenes.KinematicTree`, which has no masses.
        UnsupportedSceneError: if starts cannot be computed from the states.
        ValueError: if an array, name, window, ``max_delay`` or count does not fit, or a number is 0; if delays are to
            be identified but the scene has some; if trajectories are not finite, or the times in their ``physics`` show
            another control step, or their ``parameters`` several robots.
        FloatingPointError: if simulations with the initial parameters are unstable.
    """
    for option, count, least in (("window", window, 1), ("max_windows", max_windows, 1), ("iterations", iterations, 0)):
        check_count(option, count, least)
    scene = require_bodies(as_scene(scene), "identify_parameters")
    names, rows = find_numbers(scene.model, parameters, delays=True)
    check_trajectories(trajectories, scene, layout=scene.layout)
    _check_one_robot(trajectories)
    longest = _longest_delay(scene, max_delay) if any(array == DELAY for array, _ in rows) else 0.0
    rng = np.random.default_rng(checked_seed(seed))
    windows = _windows(scene, trajectories, window, max_windows, longest, rng)
    problem = _Problem(scene, rows, *windows, longest, num_threads)
    point, left = problem.begun(np.zeros(len(names)), iterations), problem.moved
    for again in range(_REWEIGHED):
        # Fit starts only after the first round: while the model is far off, fitted starts would be too.
        problem.coordinates = 2 * scene.model.nv if fit_starts and again else 0
        point = problem.found_again(problem.solve(point, iterations), iterations)
        left = problem.weigh(point)
        if (left <= _ROUNDING * problem.moved).all():  # without noise, weights do not matter
            break
    error = float(np.sqrt(np.mean((left / problem.moved) ** 2)))
    model, late = problem.changed(point).model, problem.late
    value = longest * point
    value[~late] = [getattr(model, array)[index].flat[0] for array, index in rows if array != DELAY]
    factor, unit = np.where(late, np.nan, np.exp(point)), np.where(late, longest, 1.0)
    return Identified(names, factor, problem.deviations(point) * unit, value, error, model)


class _Problem:
    """Least-squares problem of simulations over windows.

    A point ``[P]`` has a coordinate for each parameter: the logarithm of a factor, or a delay as a share of the
    longest. ``coordinates`` is the number of start coordinates fitted beside the point: 0, or all with their rates.
    Actions begin the longest delay before each window.
    """

    def __init__(
        self,
        scene: Scene,
        rows: Sequence[tuple[str, list[int]]],
        starts: np.ndarray,
        actions: np.ndarray,
        truth: Tensor,
        longest: float,
        num_threads: int | None,
    ) -> None:
        self.scene, self.rows, self.starts, self.actions, self.truth = scene, rows, starts, actions, truth
        self.num_threads, self.coordinates, self.steps = num_threads, 0, truth.shape[1] - 1
        self.late, self.longest = np.array([array == DELAY for array, _ in rows]), longest
        self.channels = torch.from_numpy(scene.movable & scene.predicted[:, None])
        sizes = [where.stop - where.start for where in scene.layout.delta_slices.values()]
        component = np.broadcast_to(np.repeat(np.arange(len(sizes)), sizes), self.channels.shape)
        self.component = component[self.channels.numpy()]
        still = scene.layout.delta(truth, truth[:, :1].expand_as(truth))[..., self.channels].numpy()
        self.moved = np.maximum(self._rms(still), _STILL)
        self.weight = 1 / self.moved

    def changed(self, point: np.ndarray) -> Scene:
        """Return the scene with a point's factors on its model's numbers, for simulation only."""
        factors = zip(self.rows, np.exp(point), strict=True)
        return scaled_scene(self.scene, with_inertia((*row, factor) for row, factor in factors if row[0] != DELAY))

    def residuals(self, points: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """Return weighted residuals ``[V, W, T + 1, channels]`` for ``points`` ``[V, P]`` and ``starts`` ``[V, W, S]``.

        Residuals of unstable simulations are infinite.
        """
        variants, count = [self.changed(point) for point in points], len(self.starts)
        simulated = Simulator(variants, self.num_threads).rollout(
            starts.reshape(-1, starts.shape[-1]),
            np.concatenate([self._acting(point) for point in points]),
            np.repeat(np.arange(len(points)), count),
        )
        state = simulated["state"].unflatten(0, (len(points), count))
        truth = self.truth[:, : self.steps + 1]
        off = self.scene.layout.delta(truth.expand_as(state), state)[..., self.channels]
        off = torch.where(simulated["stable"].view(len(points), count, 1, 1), off, torch.inf)
        return off.numpy() * self.weight

    def _acting(self, point: np.ndarray) -> np.ndarray:
        """Return the windows' actions ``[W, T, A]``, or with delays those that act, ``[W, T, substeps, A]``."""
        if not self.longest:
            return self.actions[:, : self.steps]
        delay, substeps = np.zeros(self.actions.shape[-1]), self.scene.substeps
        for (array, rows), share in zip(self.rows, point, strict=True):
            if array == DELAY:
                delay[rows] = share * self.longest / self.scene.model.opt.timestep  # physics steps
        whole = np.floor(delay).astype(int)
        first = (self.actions.shape[1] - (self.truth.shape[1] - 1)) * substeps
        newer = first + np.arange(self.steps * substeps)[:, None] - whole
        each = np.arange(len(delay))
        newer, older = (self.actions[:, index // substeps, each] for index in (newer, np.maximum(newer - 1, 0)))
        # An action changes within a physics step, which takes the mean.
        acting = newer + (delay - whole) * (older - newer)
        return acting.reshape(len(acting), self.steps, substeps, -1)

    def begun(self, point: np.ndarray, iterations: int) -> np.ndarray:
        """Return a start point: the best over whole windows of ``point`` and of fits to windows' first steps.

        With delays, the fits begin at several.
        """
        whole, count = self.steps, 1
        if self.longest:
            count = min(max(round(self.longest / self.scene.timestep), 1), _FIRST_DELAYS)
        for share in _FIRST:
            tried = [point]
            self.steps = max(1, round(share * whole))
            for delay in np.arange(count) / count:
                try:
                    begin = np.where(self.late, np.maximum(delay, point), point)
                    tried.append(self.solve(begin, min(iterations, _FIRST_ITERATIONS) if count > 1 else iterations))
                except FloatingPointError:  # the fit of whole windows reports it
                    continue
            self.steps, count = whole, 1
            costs = np.square(self.residuals(np.stack(tried), np.stack((self.starts,) * len(tried)))).sum((1, 2, 3))
            point = tried[int(costs.argmin())]
        return point

    def weigh(self, point: np.ndarray) -> np.ndarray:
        """Weight components by the inverse of their residuals ``[channels]``, and return these."""
        left = self._rms(self.residuals(point[None], self.starts[None])[0] / self.weight)
        # A component with hardly more than rounding errors left must not dominate.
        self.weight = 1 / np.maximum(left, 1e-6 * self.moved)
        return left

    def solve(self, point: np.ndarray, iterations: int) -> np.ndarray:
        """Minimise the squared residuals from ``point`` on; return the point of the minimum."""
        damping = 1.0
        for _ in range(iterations):
            off, slope, by_start = self._linearized(point)
            cost = float(np.square(off).sum())
            if not np.isfinite(cost):
                raise FloatingPointError("Simulations of the trajectories become unstable: give shorter windows.")
            reduced, reduced_slope = _without(by_start, off), _without(by_start, slope)
            flat = reduced_slope.reshape(-1, len(point))
            gradient = flat.T @ reduced.ravel()
            # A delay at its bound stays there while the squares fall beyond it.
            flat = flat * ~(self.late & np.where(gradient > 0, point <= 0, point >= 1))
            curvature, gradient = flat.T @ flat, flat.T @ reduced.ravel()
            tried = damping * np.array(_DAMPING)
            scale = np.diag(np.maximum(curvature.diagonal(), 1e-300))
            steps = np.stack([np.linalg.lstsq(curvature + each * scale, -gradient, rcond=None)[0] for each in tried])
            steps = steps.clip(-_LARGEST, _LARGEST)
            steps = np.where(self.late, steps.clip(-point, 1 - point), steps)
            starts = np.stack([self._moved(_nearest(by_start, off + slope @ step)) for step in steps])
            costs = np.square(self.residuals(point + steps, starts)).sum((1, 2, 3))
            costs = np.where(np.isfinite(costs), costs, np.inf)
            best = int(costs.argmin())
            if costs[best] < cost:
                point, self.starts, damping = point + steps[best], starts[best], max(tried[best] / 10, 1e-12)
                if np.abs(steps[best]).max() < _CONVERGED or cost - costs[best] < 1e-9 * cost:
                    break
            elif damping > 1e8:
                break
            else:
                damping *= 1e4
        return point

    def found_again(self, point: np.ndarray, iterations: int) -> np.ndarray:
        """Minimise from ``point`` again, with numbers that went to 0 back at the model's, if that fits better.

        Short windows of noisy states can drive parameters to 0, where their logarithms have no slope.
        """
        lost, starts = point < _LOST, self.starts
        if not lost.any():
            return point
        cost = np.square(self.residuals(point[None], starts[None])).sum()
        try:
            again = self.solve(np.where(lost, 0.0, point), iterations)
        except FloatingPointError:
            again = point
        if np.square(self.residuals(again[None], self.starts[None])).sum() < cost:
            return again
        self.starts = starts
        return point

    def deviations(self, point: np.ndarray) -> np.ndarray:
        """Return standard deviations ``[P]`` of the coordinates at the minimum; windows are clusters."""
        off, slope, by_start = self._linearized(point)
        off, slope = _without(by_start, off), _without(by_start, slope)
        windows, count = len(off), len(point)
        flat = slope.reshape(-1, count)
        inverse, known = _inverse(flat.T @ flat)
        # Residuals within a window are correlated. With few windows, each step is a cluster.
        parts = windows if windows > 2 * count else windows * self.truth.shape[1]
        scores = np.einsum("wrp,wr->wp", slope.reshape(parts, -1, count), off.reshape(parts, -1))
        free = max(parts - count - windows * self.coordinates * (parts > windows), 1)
        covariance = inverse @ (scores.T @ scores) @ inverse * parts / free
        determined = known & (np.abs(point) < np.where(self.late, 1 - _CONVERGED, _FAR))
        determined &= (self.moved > _STILL).any()  # a robot at rest bounds parameters at most
        return np.where(determined, np.sqrt(np.maximum(covariance.diagonal(), 0)), np.inf)

    def _linearized(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return residuals ``[W, R]`` and their derivatives by the point ``[W, R, P]`` and by starts ``[W, R, Q]``."""
        count, size = len(point), self.coordinates
        ahead = np.where(self.late & (point > 0.5), -_DIFFERENCE, _DIFFERENCE)  # delays stay within their bounds
        points = np.concatenate((point[None], point + np.diag(ahead), np.tile(point, (size, 1))))
        changes = _DIFFERENCE * np.eye(size)[:, None].repeat(len(self.starts), 1)  # [Q, W, Q]
        starts = [self.starts] * (1 + count) + [self._moved(change) for change in changes]
        residuals = self.residuals(points, np.stack(starts)).reshape(1 + count + size, len(self.starts), -1)
        step = np.append(ahead, np.full(size, _DIFFERENCE))
        slopes = np.moveaxis(residuals[1:] - residuals[0], 0, -1) / step
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


def _longest_delay(scene: Scene, max_delay: float) -> float:
    """Return ``max_delay`` after a check; ValueError if the scene has delays of its own."""
    if not 0 < max_delay < np.inf:
        raise ValueError(f"max_delay={max_delay!r} must be seconds, above 0.")
    if scene.delays.size:
        late = [scene.actuator_names[each] for each in np.flatnonzero(scene.delays.lag)]
        raise ValueError(f"{DELAY}: actuators {late} of scene {scene.name!r} have delays: load it without them.")
    return float(max_delay)


def _check_one_robot(trajectories: TensorDictBase) -> None:
    for name, value in trajectories.select("parameters", strict=False).items(True, True):
        if not bool((value == value[:1]).all()):
            raise ValueError(f"The trajectories are of several robots: {name} differ. Identify one at a time.")


def _windows(
    scene: Scene, trajectories: TensorDictBase, window: int, most: int, longest: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, Tensor]:
    """Cut windows: starts ``[W, S]``, actions ``[W, L + T, A]`` and states ``[W, T + 1, N, C]``.

    Actions begin ``L`` steps before a window, the ``longest`` delay.
    """
    state, action = (trajectories[key].detach().cpu() for key in ("state", "action"))
    steps, before = action.shape[1], int(np.ceil(longest / scene.timestep - 1e-6))
    if window > steps - before:
        less = f", less the {before} of max_delay={longest:g}" if before else ""
        raise ValueError(f"window={window} must be from 1 to the trajectories' {steps} steps{less}.")
    places = [(one, first) for one in range(len(action)) for first in range(before, steps - window + 1, window)]
    if len(places) > most:
        places = [places[each] for each in sorted(rng.choice(len(places), most, replace=False))]
    truth = torch.stack([state[one, first : first + window + 1] for one, first in places]).double()
    actions = torch.stack([action[one, first - before : first + window] for one, first in places]).double().numpy()
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
