"""Limits on the amplitude and speed of random controls, found in simulation, that keep joints below a speed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_gn.data.controls import spline_controls
from torchrl_gn.data.holding import actuator_moments, pose_holding_controls
from torchrl_gn.data.servo_targets import position_targets
from torchrl_gn.data.simulate import Simulator
from torchrl_gn.data.start_states import draw_start_states
from torchrl_gn.scenes.actuator_kinds import actuator_kind, drive_joints
from torchrl_gn.scenes.scene import Scene

_SPEEDS = {int(mujoco.mjtJoint.mjJNT_HINGE): math.pi, int(mujoco.mjtJoint.mjJNT_SLIDE): 1.0}  # slow, rad/s or m/s
# Speed limits of joints: multiples of the slow speeds (with and without joint limits), and joint ranges per second.
_LIVELY, _ENDLESS, _CROSSINGS = 2.0, 4.0, 4.0
_SEQUENCES, _STEPS, _ROUNDS = 16, 60, 6  # simulated sequences, their steps, and rounds of lowering limits
_QUANTILE = 0.9  # of a joint's speeds, compared with its speed limit
_WILD, _LEAST, _LARGEST_CUT, _NO_HELP = 1.5, 0.02, 0.4, 0.9


@dataclass(frozen=True)
class ControlLimits:
    """Limits of each action that keep the joints below their speed limits nine tenths of the time.

    The speed limit of a joint with a range is 2 pi rad/s or 2 m/s, and at most four joint ranges per second; without a
    range it is 4 pi rad/s or 4 m/s. Full controls stay as they are if their joints exceed the speed limit by less than
    half.
    """

    amplitude: np.ndarray  # [A] of motors, as a share of their bounds; 1 if full controls need no limit
    target_speed: np.ndarray  # [A] of position targets, in control units per second; inf if no speed needs a limit


def slow_targets(model: mujoco.MjModel) -> np.ndarray:
    """Return speed limits ``[A]`` of slow targets, control units/s: pi rad, 1 m, or the bounds' width if less."""
    fastest = np.ptp(model.actuator_ctrlrange, axis=1)
    for actuator, joint, a_unit in _servos_at_joints(model):
        if speed := _SPEEDS.get(int(model.jnt_type[joint])):
            fastest[actuator] = min(fastest[actuator], speed * a_unit)
    return fastest


def _servos_at_joints(model: mujoco.MjModel) -> Iterator[tuple[int, int, float]]:
    """Yield each position servo of a joint, the joint, and the change of control per unit of its coordinate."""
    at_joints = drive_joints(model)
    for actuator in range(model.nu):
        if at_joints[actuator] and actuator_kind(model, actuator) == "position":
            slope = model.actuator_biasprm[actuator, 1]
            a_unit = abs(model.actuator_gear[actuator, 0] * slope / model.actuator_gainprm[actuator, 0])
            yield actuator, int(model.actuator_trnid[actuator, 0]), float(a_unit)


def find_control_limits(simulator: Simulator, rest: np.ndarray, knot_interval: float) -> ControlLimits:
    """Lower the limits until joints of the first scene keep theirs; skip actuators for which that does not help."""
    scene, model = simulator.scene, simulator.scene.model
    kinds = np.array([actuator_kind(model, actuator) for actuator in range(model.nu)])
    servos, slow = kinds == "position", slow_targets(model)
    rng, variant = np.random.default_rng(0), np.zeros(_SEQUENCES, dtype=np.int64)
    start, _ = draw_start_states(simulator, variant, rng)
    holding = np.clip(pose_holding_controls(simulator, start, variant, rest), scene.action_low, scene.action_high)
    driven, fastest = _driven(scene, start[0]), _fastest(model)
    splines = spline_controls(scene, _SEQUENCES, _STEPS, rng, knot_interval=knot_interval)
    amplitude, speed = np.ones(model.nu), np.full(model.nu, math.inf)
    open_, before = kinds != "velocity", (amplitude, speed, np.full(model.nu, math.inf))
    for round_ in range(_ROUNDS):
        controls = holding[:, None] + amplitude * (splines - rest)
        bounded = np.isfinite(speed)
        controls[..., servos & ~bounded] = splines[..., servos & ~bounded]
        if bounded.any():
            targets = holding[:, bounded], scene.action_low[bounded], scene.action_high[bounded]
            step = np.broadcast_to(speed[bounded] * scene.timestep, targets[0].shape)
            controls[..., bounded] = position_targets(*targets, np.ones_like(step), step, _STEPS, knot_interval, rng)
        moved = simulator.rollout(start, np.clip(controls, scene.action_low, scene.action_high), variant)
        excess = _excess(model, np.asarray(moved["physics"][moved["stable"]]), fastest)
        ratio = np.where(driven, excess, 0.0).max(axis=1, initial=0.0)
        # Gravity and other actuators move a joint too: undo cuts that did not help.
        idle = open_ & (ratio > 1) & (ratio > _NO_HELP * before[2])
        amplitude, speed = (np.where(idle, *pair) for pair in zip(before[:2], (amplitude, speed), strict=True))
        open_ &= ~idle
        wild = open_ & (ratio > (1 if round_ else _WILD))
        if not wild.any():
            break
        before = amplitude, speed, np.where(wild, ratio, math.inf)
        cut = np.maximum(1 / np.maximum(ratio, 1), _LARGEST_CUT)
        amplitude = np.where(wild & ~servos, np.maximum(amplitude * cut, _LEAST), amplitude)
        lowered = np.where(np.isfinite(speed), np.maximum(speed * cut, slow), _LIVELY * slow)
        speed = np.where(wild & servos, lowered, speed)
    return ControlLimits(amplitude, speed)


def _fastest(model: mujoco.MjModel) -> np.ndarray:
    """Return the joints' speed limits ``[nv]`` in rad/s or m/s; inf for free joints."""
    fastest = np.full(model.nv, math.inf)
    for joint in range(model.njnt):
        dof, limited, span = model.jnt_dofadr[joint], bool(model.jnt_limited[joint]), np.ptp(model.jnt_range[joint])
        if (slow := _SPEEDS.get(int(model.jnt_type[joint]))) is not None:
            fastest[dof] = min(_LIVELY * slow, _CROSSINGS * span) if limited else _ENDLESS * slow
        elif model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_BALL):
            fastest[dof : dof + 3] = _ENDLESS * math.pi
    return fastest


def _excess(model: mujoco.MjModel, physics: np.ndarray, fastest: np.ndarray) -> np.ndarray:
    """Return 90 % quantiles ``[nv]`` of speeds over ``fastest`` in simulations ``[n, T, S]``; inf if ``n`` is 0."""
    if not len(physics):
        return np.full(model.nv, math.inf)
    speed = np.abs(physics[..., 1 + model.nq : 1 + model.nq + model.nv]).reshape(-1, model.nv)
    return np.quantile(speed, _QUANTILE, axis=0) / fastest


def _driven(scene: Scene, state: np.ndarray) -> np.ndarray:
    """Detect the degrees of freedom that each action moves directly, ``[A, nv]`` bool."""
    data = mujoco.MjData(scene.model)
    mujoco.mj_setState(scene.model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    mujoco.mj_fwdPosition(scene.model, data)
    return actuator_moments(scene.model, data) != 0
