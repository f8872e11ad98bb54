"""Movable components: which components of a state change can be non-zero."""

from __future__ import annotations

import mujoco
import numpy as np

_TOLERANCE = 1e-9


def movable_components(model: mujoco.MjModel, data: mujoco.MjData, body: np.ndarray, *, samples: int = 8) -> np.ndarray:
    """Mask ``[N, 12]`` of movable components for root bodies ``[N]``; ``data`` is overwritten.

    Components, world frame: position 3, rotation vector 3, linear velocity 3, angular velocity 3. A row of the body
    Jacobian that vanishes at random configurations vanishes everywhere. Constraints are ignored.
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
    """Draw a configuration, also beyond limits, which do not change the rows that vanish."""
    qpos = rng.uniform(-np.pi, np.pi, model.nq)
    for joint in range(model.njnt):
        kind, start = mujoco.mjtJoint(model.jnt_type[joint]), model.jnt_qposadr[joint]
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            start += 3
        if kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
            quat = rng.normal(size=4)
            qpos[start : start + 4] = quat / np.linalg.norm(quat)
    return qpos
