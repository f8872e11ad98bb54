"""JACO: Kinova's arm with its three-finger hand, on nothing. 100 ms, 50 physics steps of 2 ms.

Arm and hand are the model files of ``dm_control.entities.manipulators.kinova``; the
velocity actuators are those of its ``JacoArm`` and ``JacoHand``. MuJoCo's default
physics step of 2 ms is what dm_control's manipulation tasks use. Base, wrist and
hand, and the two halves of each finger, are welded: 16 bodies are 10 nodes. The
hand's elements are named ``jaco_hand/...``.
"""

from __future__ import annotations

import mujoco
import numpy as np

from torchrl_gn.scenes.systems.system import System, model_file

_LARGE = ("joint_1", "joint_2", "joint_3")
_SMALL = ("joint_4", "joint_5", "joint_6")
_FINGERS = ("finger_1", "finger_2", "finger_3")


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
    """Servo that follows a velocity target [rad/s] with limited torque [N m]."""
    actuator = spec.add_actuator(
        name=joint,
        target=joint,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        ctrllimited=True,
        ctrlrange=[-velocity, velocity],
        forcelimited=True,
        forcerange=[-force, force],
    )
    actuator.set_to_velocity(gain)


SYSTEM = System("jaco", _build, timestep=0.1)
