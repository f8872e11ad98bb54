"""JACO: Kinova's arm with its three-finger hand; control step 100 ms, 50 physics steps of 2 ms.

Model files and velocity actuators are those of ``dm_control.entities.manipulators.kinova``; 2 ms is the step of
dm_control's manipulation tasks. The base is welded to the world, the wrist to the hand, and both halves of each finger
to each other, so that 15 bodies give 10 nodes. The hand's elements are named ``jaco_hand/...``.

Variants: mass and inertia of every moving node, at fixed size; gear of every motor, which multiplies a servo's torque
and divides its target velocity.
"""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np

from torchrl_gn.scenes.systems.system import ParameterRange, System, model_file

_LARGE = ("joint_1", "joint_2", "joint_3")
_SMALL = ("joint_4", "joint_5", "joint_6")
_FINGERS = ("finger_1", "finger_2", "finger_3")
_BODIES = {  # bodies of each mass parameter's node
    **{f"mass_b_{i}": (f"b_{i}",) for i in range(1, 6)},
    "mass_hand": ("b_6", "jaco_hand/hand"),
    **{f"mass_finger_{i}": (f"jaco_hand/b_finger_{i}", f"jaco_hand/b_finger_tip_{i}") for i in (1, 2, 3)},
}
_MOTORS = {
    **{f"gear_{name}": name for name in (*_LARGE, *_SMALL)},
    **{f"gear_{name}": f"jaco_hand/{name}" for name in _FINGERS},
}
_RANGES = {name: ParameterRange(0.5, 1.5) for name in (*_BODIES, *_MOTORS)}


def _build() -> mujoco.MjSpec:
    arm = mujoco.MjSpec.from_file(model_file("third_party/kinova/jaco_arm.xml"))
    hand = mujoco.MjSpec.from_file(model_file("third_party/kinova/jaco_hand.xml"))
    for name in _LARGE:
        _add_velocity_actuator(arm, name, gain=500.0, velocity=np.deg2rad(36.0), force=30.5)
    for name in _SMALL:
        _add_velocity_actuator(arm, name, gain=500.0, velocity=np.deg2rad(48.0), force=6.8)
    for name in _FINGERS:
        _add_velocity_actuator(hand, name, gain=10.0, velocity=5.0, force=1.0)
    arm.attach(hand, prefix="jaco_hand/", site=arm.site("wristsite"))
    return arm


def _add_velocity_actuator(spec: mujoco.MjSpec, joint: str, *, gain: float, velocity: float, force: float) -> None:
    """Add a servo that follows a velocity target [rad/s] with limited torque [N m]."""
    actuator = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.ctrllimited, actuator.ctrlrange = True, [-velocity, velocity]
    actuator.forcelimited, actuator.forcerange = True, [-force, force]
    actuator.set_to_velocity(gain)


def _vary(spec: mujoco.MjSpec, parameters: Mapping[str, float]) -> None:
    for name, bodies in _BODIES.items():
        for geom in (geom for body in bodies for geom in spec.body(body).geoms):
            geom.mass *= parameters[name]
    for name, motor in _MOTORS.items():
        actuator = spec.actuator(motor)
        actuator.gear = parameters[name] * np.asarray(actuator.gear)


SYSTEM = System("jaco", _build, timestep=0.1, ranges=_RANGES, vary=_vary)
