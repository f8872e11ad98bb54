"""Which bodies are joined together by joints, and where."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_gn.scenes.topology import Topology

_TOLERANCE = 1e-12


@dataclass(frozen=True, eq=False)
class JointAnchors:
    """Where hinges and balls joint anchor every node to its parent.

    Nodes that are joined together, directly or through others, are a joint_anchors. Its root is joined
    to nothing above it: the world, or a node that hangs on a slide or a free joint.

    Attributes:
        parent: ``[N]`` parent node; itself for a root.
        parent_anchor: ``[N, 3]`` the joint anchor in the parent's frame, metres; 0 for a root.
        arm: ``[N, 3]`` the joint anchor in the node's own frame; 0 for a root.
        chain: ``[N, N]`` 1 where the second node lies between the root and the first, the first
            included and the root not.
        root: ``[N]`` root of each node's joint_anchors.
    """

    parent: np.ndarray
    parent_anchor: np.ndarray
    child_anchor: np.ndarray
    ancestors: np.ndarray
    root: np.ndarray

    @property
    def anchor_scale(self) -> float:
        """Usual length of a coordinate of an arm that is not 0, metres; 1 without any."""
        anchors = np.concatenate((self.parent_anchor, self.child_anchor))
        return float(np.sqrt(np.mean(anchors[anchors != 0] ** 2))) if anchors.any() else 1.0


def find_joint_anchors(model: mujoco.MjModel, data: mujoco.MjData, graph: Topology) -> JointAnchors:
    """Read the joint anchors of a model's joints.

    A body is joined to its parent if all its joints are hinges and balls about one point.

    Args:
        model: the scene's model.
        data: of that model at its reference, kinematics done.
        graph: its topology.
    """
    count = len(graph.body)
    parent, root = np.arange(count), np.arange(count)
    parent_anchor, child_anchor, ancestors = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, count))
    for node in range(1, count):
        body = int(graph.body[node])
        first = model.body_jntadr[body]
        joints = np.arange(first, first + model.body_jntnum[body])
        if not _pinned(model, joints):
            continue
        above = int(graph.parent[node])
        anchor, frame = data.xanchor[joints[0]], data.xmat[graph.body[above]].reshape(3, 3)
        parent[node], root[node] = above, root[above]
        parent_anchor[node] = frame.T @ (anchor - data.xpos[graph.body[above]])
        child_anchor[node] = model.jnt_pos[joints[0]]
        ancestors[node] = ancestors[above]
        ancestors[node, node] = 1
    return JointAnchors(parent, parent_anchor, child_anchor, ancestors, root)


def _pinned(model: mujoco.MjModel, joints: np.ndarray) -> bool:
    turning = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_BALL))
    if len(joints) == 0 or not np.isin(model.jnt_type[joints], turning).all():
        return False
    return bool(np.abs(model.jnt_pos[joints] - model.jnt_pos[joints[0]]).max() < _TOLERANCE)
