"""Motor controls that follow slow random joint paths, as a torque controller would."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from torchrl_gn.data.holding import MotorLaws
from torchrl_gn.data.servo_targets import position_targets
from torchrl_gn.data.simulate import Simulator

_BANDWIDTH = 0.2  # of the critically damped controller, in radians per control step


def tracking_controls(
    simulator: Simulator,
    physics: np.ndarray,
    variant: np.ndarray,
    controls: np.ndarray,
    disturbance: np.ndarray,
    rng: np.random.Generator,
    *,
    width: np.ndarray,
    speed: np.ndarray,
    knot_interval: float,
) -> np.ndarray | None:
    """Return controls ``[n, T, A]`` whose motors follow random paths from states ``[n, S]`` by inverse dynamics.

    Return None if the motors' robots are not fully actuated. Other actuators keep their ``controls``.

    Args:
        disturbance: ``[n, T, A]``, added to the motors' controls before these are clipped.
        width: width ``[n, 1]`` of the paths, as a share of the joints' ranges (or 2 pi).
        speed: largest speed ``[n, 1]`` of the paths, as a share of pi rad/s or 1 m/s.
    """
    scene, steps = simulator.scene, controls.shape[1]
    laws = MotorLaws(scene.model)
    if not len(physics) or (joints := laws.driven_joints(physics[0])) is None:
        return None
    model, here = scene.model, 1 + scene.model.jnt_qposadr[joints]
    limited = model.jnt_limited[joints] != 0
    whole = 2 * math.pi * np.round(physics[:, here] / (2 * math.pi))  # turns or steps that an unlimited joint has made
    low = np.where(limited, model.jnt_range[joints, 0], whole - math.pi)
    high = np.where(limited, model.jnt_range[joints, 1], whole + math.pi)
    slide = model.jnt_type[joints] == int(mujoco.mjtJoint.mjJNT_SLIDE)
    fastest = speed * np.where(slide, 1.0, math.pi) * scene.timestep
    width = np.broadcast_to(width, fastest.shape)
    path = position_targets(physics[:, here], low, high, width, fastest, steps, knot_interval, rng)
    dofs, frequency = model.jnt_dofadr[joints], _BANDWIDTH / scene.timestep
    at_rate = 1 + model.nq + dofs
    controls, state = controls.copy(), physics.copy()
    for step in range(steps):
        acceleration = frequency**2 * (path[:, step] - state[:, here]) - 2 * frequency * state[:, at_rate]
        for row in np.flatnonzero(np.isfinite(state).all(1)):
            variant_model = simulator.scenes[variant[row]].model
            controls[row, step, laws.motors] = laws.controls(variant_model, state[row], dofs, acceleration[row])
        controls[:, step] += np.where(laws.mask, disturbance[:, step], 0.0)
        controls[:, step] = np.clip(controls[:, step], scene.action_low, scene.action_high)
        state, _ = simulator.step(state, controls[:, step], variant)
    return controls
