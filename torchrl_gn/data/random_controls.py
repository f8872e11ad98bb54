"""Random controls that fit their actuators: torques, positions or velocities."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from torchrl_gn.data.controls import check_knot_interval, evaluate_cubics, spline_controls
from torchrl_gn.data.simulate import Simulator
from torchrl_gn.scenes.actuator_kinds import actuator_kind, drive_joints, holding_controls
from torchrl_gn.scenes.control_bounds import require_bounds
from torchrl_gn.scenes.keyframes import reference_keyframe

_SPEEDS = {int(mujoco.mjtJoint.mjJNT_HINGE): math.pi, int(mujoco.mjtJoint.mjJNT_SLIDE): 1.0}  # of targets, rad/s or m/s
_SCALES = (0.2, 1.0)  # of motors, velocity targets and the speed of position targets, by sequence
_LEAST_WIDTH = 0.05  # of the interval of position targets, as a share of the bounds
_LATEST_REVERSAL = 4.0  # time between reversals of velocity targets, in knot intervals


def random_controls(
    simulator: Simulator,
    physics: np.ndarray,
    steps: int,
    rng: int | np.random.Generator,
    *,
    knot_interval: float = 10.0,
    target_speed: float | None = 1.0,
    variant: np.ndarray | None = None,
) -> np.ndarray:
    """Draw smooth action sequences ``[n, T, A]`` from states ``[n, S]``, float64, in the actuators' units.

    Systems of the paper get :func:`~torchrl_gn.data.spline_controls`. Actuators of other models, by kind:

    - motors, and all that is neither of the following: these splines, scaled in each sequence by a factor in [0.2, 1]
      towards the controls of the reference keyframe, or towards 0;
    - position servos: targets from the one that holds the given state, on splines within a random part of the bounds
      around it; in a second they move at most 0.2 to 1 times the bounds' width, pi rad or 1 m of their joint,
      times ``target_speed``; with None as motors, as a planner may choose them;
    - velocity servos: splines whose knots alternate in sign, 1 to 4 ``knot_interval`` apart, scaled in each sequence
      by a factor in [0.2, 1]; as motors if the bounds do not include both directions.

    Args:
        knot_interval: least time between knots, in control steps.
        variant: ``[n]``, scene of each sequence; default: the scenes in turn.

    Raises:
        ValueError: ``knot_interval`` or ``target_speed`` is not above 0 and finite.
        SceneError: an action has no bounds.
    """
    scene, n = simulator.scene, len(physics)
    rng = np.random.default_rng(rng)
    check_target_speed(target_speed)
    if "system" in scene.origin or not (n and steps and scene.num_actions):
        return spline_controls(scene, n, steps, rng, knot_interval=knot_interval)
    check_knot_interval(knot_interval)
    require_bounds(scene)
    model, low, high = scene.model, scene.action_low, scene.action_high
    kinds = np.array([actuator_kind(model, actuator) for actuator in range(model.nu)])
    key = reference_keyframe(model)
    rest = np.clip(np.zeros(model.nu) if key is None else model.key_ctrl[key], low, high)
    scale = rng.uniform(*_SCALES, (n, 1, 1))
    controls = rest + scale * (spline_controls(scene, n, steps, rng, knot_interval=knot_interval) - rest)
    reversing = (kinds == "velocity") & (low < 0) & (high > 0)
    if reversing.any():
        ends = low[reversing], high[reversing]
        controls[..., reversing] = scale * _velocity_targets(*ends, n, steps, knot_interval, rng)
    if target_speed is not None and (servos := kinds == "position").any():
        variant = np.arange(n) % len(simulator.scenes) if variant is None else variant
        start = _holding_targets(simulator, physics, variant, np.flatnonzero(servos))
        fastest = (target_speed * scale[:, 0] * _fastest_targets(model) * scene.timestep)[:, servos]
        controls[..., servos] = _position_targets(start, low[servos], high[servos], fastest, steps, knot_interval, rng)
    return controls


def check_target_speed(target_speed: float | None) -> None:
    """Raise ValueError if the factor is not above 0 and finite."""
    if target_speed is not None and not 0 < target_speed < math.inf:
        raise ValueError(f"target_speed must be above 0 and finite, got {target_speed}")


def _velocity_targets(
    low: np.ndarray, high: np.ndarray, n: int, steps: int, knot_interval: float, rng: np.random.Generator
) -> np.ndarray:
    from scipy.interpolate import CubicSpline  # here, as importing it takes a second

    knots, size = math.ceil((steps - 1) / knot_interval) + 3, (n, len(low))
    sign = (-1.0) ** (np.arange(knots)[:, None, None] + rng.integers(2, size=size))
    values = rng.uniform(0.0, 1.0, (knots, *size)) * np.where(sign > 0, high, low)
    spline = CubicSpline(np.arange(knots), values, bc_type="natural")
    interval = knot_interval * _LATEST_REVERSAL ** rng.uniform(0.0, 1.0, size)[:, None]
    time = rng.uniform(0.0, 1.0, size)[:, None] + np.arange(steps)[:, None] / interval
    return np.clip(evaluate_cubics(spline.c, time), low, high)


def _position_targets(
    start: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    fastest: np.ndarray,
    steps: int,
    knot_interval: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Targets ``[n, T, A]`` from ``start`` ``[n, A]`` on that change by at most ``fastest`` ``[n, A]`` a step."""
    from scipy.interpolate import CubicSpline  # here, as importing it takes a second

    start = np.clip(start, low, high)
    width = (high - low) * _LEAST_WIDTH ** rng.uniform(0.0, 1.0, start.shape)
    first = np.clip(start - rng.uniform(0.0, 1.0, start.shape) * width, low, high - width)
    knots = math.ceil((steps - 1) / knot_interval) + 2
    values = first + width * rng.uniform(0.0, 1.0, (knots, *start.shape))
    values[0] = start
    spline = CubicSpline(np.arange(knots), values, bc_type="clamped")  # at rest at both ends
    interval = np.maximum(knot_interval, _peak_slope(spline.c) / fastest)
    time = np.arange(steps)[:, None] / interval[:, None]
    return np.clip(evaluate_cubics(spline.c, time), low, high)


def _peak_slope(coefficients: np.ndarray) -> np.ndarray:
    """Largest slope ``[n, A]`` of cubics ``[4, K - 1, n, A]`` on their unit intervals."""
    a, b, c, _ = coefficients
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = np.clip(np.nan_to_num(-b / (3 * a)), 0.0, 1.0)
    slopes = [(3 * a * x + 2 * b) * x + c for x in (0.0, 1.0, turn)]
    return np.abs(slopes).max(axis=(0, 1))


def _fastest_targets(model: mujoco.MjModel) -> np.ndarray:
    """Fastest change ``[A]`` of position targets, in the controls' units a second."""
    fastest, at_joints = np.ptp(model.actuator_ctrlrange, axis=1), drive_joints(model)
    for actuator in range(model.nu):
        joint, slope = model.actuator_trnid[actuator, 0], model.actuator_biasprm[actuator, 1]
        if slope and at_joints[actuator] and (speed := _SPEEDS.get(int(model.jnt_type[joint]))):
            a_unit = abs(model.actuator_gear[actuator, 0] * slope / model.actuator_gainprm[actuator, 0])
            fastest[actuator] = min(fastest[actuator], speed * a_unit)
    return fastest


def _holding_targets(simulator: Simulator, physics: np.ndarray, variant: np.ndarray, servos: np.ndarray) -> np.ndarray:
    """Controls ``[n, servos]`` at which position servos exert no force on states ``[n, S]`` at rest."""
    data, targets = mujoco.MjData(simulator.scene.model), np.zeros((len(physics), len(servos)))
    for row, state in enumerate(physics):
        model = simulator.scenes[variant[row]].model
        mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        for stage in ("kinematics", "comPos", "tendon", "transmission"):
            getattr(mujoco, f"mj_{stage}")(model, data)
        targets[row] = holding_controls(model, servos, data.actuator_length[servos])
    return targets
