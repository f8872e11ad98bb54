"""What can move in a scene: movable channels of the state change."""

from __future__ import annotations

import mujoco
import numpy as np

_TOLERANCE = 1e-9


def movable_components(model: mujoco.MjModel, data: mujoco.MjData, body: np.ndarray, *, samples: int = 8) -> np.ndarray:
    """Components of the state change that can ever differ from zero.

    A component is dead if its row of the body's Jacobian (world frame, at the
    body frame's origin) is zero in every configuration. The Jacobian is analytic
    in the configuration, so a row that is zero at a few random ones is zero at
    all. Constraints (joint limits, equalities) can only remove motion: they are
    not looked at.

    Args:
        model: compiled model.
        data: of that model; what is in it is overwritten.
        body: ``[N]`` root body of each node.
        samples: number of random configurations.

    Returns:
        ``[N, 12]`` bool: position 3, rotation vector 3, linear velocity 3, angular
        velocity 3. Position shares the rows of linear velocity, rotation those of
        angular velocity.
    """
    rng = np.random.default_rng(0)
    largest = np.zeros((len(body), 6))  # largest entry of every Jacobian row
    jacobian = np.zeros((6, model.nv))
    for _ in range(samples):
        data.qpos[:] = _random_configuration(model, rng)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        for node, body_id in enumerate(body):
            mujoco.mj_jacBody(model, data, jacobian[:3], jacobian[3:], int(body_id))
            largest[node] = np.maximum(largest[node], np.abs(jacobian).max(axis=1, initial=0.0))
    moves = largest > _TOLERANCE
    return np.concatenate([moves, moves], axis=1)


def _random_configuration(model: mujoco.MjModel, rng: np.random.Generator) -> np.ndarray:
    """Generic configuration: limits are soft in MuJoCo and do not change which rows vanish."""
    qpos = rng.uniform(-np.pi, np.pi, model.nq)
    for joint in range(model.njnt):
        kind, start = mujoco.mjtJoint(model.jnt_type[joint]), model.jnt_qposadr[joint]
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            start += 3
        if kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
            quat = rng.normal(size=4)
            qpos[start : start + 4] = quat / np.linalg.norm(quat)
    return qpos
