"""Nodes and edges of a MuJoCo model: groups of welded bodies, joints between them."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np


@dataclass(frozen=True)
class Topology:
    """Graph structure of a model, without any parameter."""

    body: np.ndarray  # [N] root body of each node, ascending, world first
    node_of_body: np.ndarray  # [nbody] node of each body
    parent: np.ndarray  # [N] parent node, -1 for the world
    senders: np.ndarray  # [E] edges 2 j and 2 j + 1 are joint j's: parent to child, then child to parent
    receivers: np.ndarray  # [E]


def topology(model: mujoco.MjModel) -> Topology:
    """Graph structure of a compiled model.

    A node is a group of bodies welded together (``body_weldid``). Bodies fixed to the world, mocap bodies too, belong
    to node 0.
    """
    body = np.unique(model.body_weldid)
    node_of_body = np.searchsorted(body, model.body_weldid)
    parent = node_of_body[model.body_parentid[body]]
    parent[0] = -1
    child_of_joint = node_of_body[model.jnt_bodyid]
    pairs = np.stack([parent[child_of_joint], child_of_joint], axis=1)  # [J, 2] parent, child
    return Topology(
        body=body.astype(np.int64),
        node_of_body=node_of_body.astype(np.int64),
        parent=parent.astype(np.int64),
        senders=pairs.reshape(-1).astype(np.int64),
        receivers=pairs[:, ::-1].reshape(-1).astype(np.int64),
    )


def offset(model: mujoco.MjModel, body: int, ancestor: int) -> tuple[np.ndarray, np.ndarray]:
    """Position ``[3]`` and quaternion ``[4]`` of a body in an ancestor's (or its own) frame, joints at reference."""
    pos, quat = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    while body != ancestor:
        rotated, product = np.empty(3), np.empty(4)
        mujoco.mju_rotVecQuat(rotated, pos, model.body_quat[body])
        mujoco.mju_mulQuat(product, model.body_quat[body], quat)
        pos, quat = model.body_pos[body] + rotated, product
        body = int(model.body_parentid[body])
    return pos, quat
