"""Kinds of actuators: motors, position servos and velocity servos."""

from __future__ import annotations

import math
from typing import Literal

import mujoco
import numpy as np

ActuatorKind = Literal["motor", "position", "velocity"]


def actuator_kind(model: mujoco.MjModel, actuator: int) -> ActuatorKind:
    """Classify an actuator as position servo, velocity servo, or motor if it follows no target.

    An integrating position servo counts as a velocity servo: its control is its target's velocity.
    """
    gain, bias = model.actuator_gainprm[actuator, 0], model.actuator_biasprm[actuator]
    fixed = model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED and gain != 0
    if not fixed or model.actuator_biastype[actuator] != mujoco.mjtBias.mjBIAS_AFFINE:
        return "motor"
    if bias[1] != 0:
        integrates = model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_INTEGRATOR
        return "velocity" if integrates else "position"
    return "velocity" if math.isclose(bias[2], -gain, rel_tol=1e-6) else "motor"


def holding_controls(model: mujoco.MjModel, servos: np.ndarray | int, length: np.ndarray) -> np.ndarray:
    """Return controls at which position servos exert no force on transmissions of these lengths, at rest."""
    gain, bias = model.actuator_gainprm[servos, 0], model.actuator_biasprm[servos]
    return length * (-bias[..., 1] / gain) - bias[..., 0] / gain


def activated_servos(model: mujoco.MjModel) -> np.ndarray:
    """Find position servos ``[K]`` that filter or integrate their control, so that an activation is their target."""
    kind = mujoco.mjtDyn
    follows = np.isin(
        model.actuator_dyntype, (int(kind.mjDYN_FILTER), int(kind.mjDYN_FILTEREXACT), int(kind.mjDYN_INTEGRATOR))
    )
    plain = (model.actuator_actnum == 1) & (model.actuator_plugin < 0)
    fixed = (model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED)) & (model.actuator_gainprm[:, 0] != 0)
    servo = (model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)) & (model.actuator_biasprm[:, 1] != 0)
    return np.flatnonzero(follows & plain & fixed & servo)


def turning_servos(model: mujoco.MjModel) -> np.ndarray:
    """Return the length ``[A]`` per radian of position servos of a ball, or of a site relative to another; else 0.

    Their error is within half a turn: MuJoCo takes the nearest of the targets that are whole turns apart. An integrated
    target changes by these turns.
    """
    if not hasattr(model, "actuator_ctrlnum"):  # MuJoCo before 3.11 takes the target as it is
        return np.zeros(len(model.actuator_trntype))
    gear, kind = model.actuator_gear, mujoco.mjtTrn
    servo = (model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED)) & np.isin(
        model.actuator_dyntype, (int(mujoco.mjtDyn.mjDYN_NONE), int(mujoco.mjtDyn.mjDYN_INTEGRATOR))
    )
    servo &= model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)
    servo &= model.actuator_gainprm[:, 0] == -model.actuator_biasprm[:, 1]
    at_site = (model.actuator_trntype == int(kind.mjTRN_SITE)) & (model.actuator_trnid[:, 1] >= 0)
    balls = np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_BALL))
    at_ball = drive_joints(model) & np.isin(model.actuator_trnid[:, 0], balls)
    turning = np.where(at_ball[:, None], gear[:, :3], gear[:, 3:])
    return np.where(servo & (at_ball | at_site & ~gear[:, :3].any(1)), np.linalg.norm(turning, axis=1), 0.0)


def switched_off(model: mujoco.MjModel) -> np.ndarray:
    """Find actuators ``[A]``, bool, that exert no force: all, or those whose group is switched off."""
    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_ACTUATION):
        return np.ones(model.nu, dtype=bool)
    return np.array([in_disabled_group(model, actuator) for actuator in range(model.nu)], dtype=bool)


def in_disabled_group(model: mujoco.MjModel, actuator: int) -> bool:
    """Return True if an actuator's group is switched off (``actuatorgroupdisable``)."""
    group = int(model.actuator_group[actuator])
    return 0 <= group < 31 and bool(model.opt.disableactuator >> group & 1)


def drive_joints(model: mujoco.MjModel) -> np.ndarray:
    """Find actuators ``[A]``, bool, that drive a joint directly."""
    kind = mujoco.mjtTrn
    return np.isin(model.actuator_trntype, (int(kind.mjTRN_JOINT), int(kind.mjTRN_JOINTINPARENT)))
