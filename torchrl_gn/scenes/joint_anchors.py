"""Joint anchors: the points at which joints connect bodies."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_gn.scenes.topology import Topology

_TOLERANCE = 1e-12


@dataclass(frozen=True, eq=False)
class JointAnchors:
    """Anchors of hinges and balls, which connect nodes to their parents in subtrees.

    A subtree's root has no anchor: it is the world, or a node on a slide or free joint.
    """

    parent: np.ndarray  # [N] parent node; a root's is itself
    parent_anchor: np.ndarray  # [N, 3] anchor in the parent's frame, metres; 0 for a root
    child_anchor: np.ndarray  # [N, 3] anchor in the node's own frame, metres; 0 for a root
    ancestors: np.ndarray  # [N, N] 1 where the column's node is the row's or its ancestor, roots excluded
    root: np.ndarray  # [N] root of each node's subtree

    @property
    def anchor_scale(self) -> float:
        """Root mean square of the non-zero coordinates of the anchor offsets, metres; 1 without any."""
        offsets = np.concatenate((self.parent_anchor, self.child_anchor))
        return float(np.sqrt(np.mean(offsets[offsets != 0] ** 2))) if offsets.any() else 1.0


def find_joint_anchors(model: mujoco.MjModel, data: mujoco.MjData, graph: Topology) -> JointAnchors:
    """Joint anchors of a model: bodies whose joints are all hinges and balls about one point have one.

    ``data`` must be at its reference, kinematics done.
    """
    count = len(graph.body)
    parent, root = np.arange(count), np.arange(count)
    parent_anchor, child_anchor, ancestors = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, count))
    for node in range(1, count):
        body = int(graph.body[node])
        first = model.body_jntadr[body]
        joints = np.arange(first, first + model.body_jntnum[body])
        if not _has_anchor(model, joints):
            continue
        before = int(graph.parent[node])
        anchor, frame = data.xanchor[joints[0]], data.xmat[graph.body[before]].reshape(3, 3)
        parent[node], root[node] = before, root[before]
        parent_anchor[node] = frame.T @ (anchor - data.xpos[graph.body[before]])
        child_anchor[node] = model.jnt_pos[joints[0]]
        ancestors[node] = ancestors[before]
        ancestors[node, node] = 1
    return JointAnchors(parent, parent_anchor, child_anchor, ancestors, root)


def _has_anchor(model: mujoco.MjModel, joints: np.ndarray) -> bool:
    rotational = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_BALL))
    if len(joints) == 0 or not np.isin(model.jnt_type[joints], rotational).all():
        return False
    return bool(np.abs(model.jnt_pos[joints] - model.jnt_pos[joints[0]]).max() < _TOLERANCE)
