"""Nodes and edges of a MuJoCo model: groups of welded bodies, joints between them."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np


@dataclass(frozen=True)
class Topology:
    """Graph structure of a model, without any parameter.

    Attributes:
        body: ``[N]`` body id of each node's root body, ascending, world first.
        node_of_body: ``[nbody]`` node that carries each body.
        parent: ``[N]`` parent node, -1 for the world.
        senders: ``[E]`` edges ``2 j`` and ``2 j + 1`` belong to joint ``j``: parent to child,
            then child to parent.
        receivers: ``[E]``.
    """

    body: np.ndarray
    node_of_body: np.ndarray
    parent: np.ndarray
    senders: np.ndarray
    receivers: np.ndarray


def topology(model: mujoco.MjModel) -> Topology:
    """Read the graph structure of a compiled model.

    A node is a group of bodies welded together (``body_weldid``); the bodies of
    a group need not be contiguous. Bodies without a joint up to the world,
    mocap bodies too, belong to node 0.
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
    """Pose of a body in an ancestor's frame with every joint between them at its reference.

    Args:
        model: compiled model.
        body: body id.
        ancestor: body id on the path from ``body`` to the world, or ``body`` itself.

    Returns:
        Position ``[3]`` and quaternion ``[4]``, w-first.
    """
    pos, quat = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    while body != ancestor:
        rotated, product = np.empty(3), np.empty(4)
        mujoco.mju_rotVecQuat(rotated, pos, model.body_quat[body])
        mujoco.mju_mulQuat(product, model.body_quat[body], quat)
        pos, quat = model.body_pos[body] + rotated, product
        body = int(model.body_parentid[body])
    return pos, quat
