"""Nodes and edges of a MuJoCo model: groups of welded bodies, the joints between them, and the joint anchors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np


@dataclass(frozen=True)
class EdgePair:
    """Two directed edges between nodes, for a joint, an actuator or an equality constraint."""

    name: str  # of the joint, actuator or constraint
    kind: str  # "hinge", "slide", "ball", "free"; "site", "body"; "connect", "weld"
    first: int  # node; a joint's parent
    second: int  # node; a joint's child

    @property
    def element(self) -> str:
        """Kind of element the pair belongs to: ``"joint"``, ``"actuator"`` or ``"constraint"``."""
        others = {"site": "actuator", "body": "actuator", "connect": "constraint", "weld": "constraint"}
        return others.get(self.kind, "joint")


@dataclass(frozen=True)
class Topology:
    """Graph structure of a model, without any parameter."""

    body: np.ndarray  # [N] root body of each node, ascending, world first
    node_of_body: np.ndarray  # [nbody] node of each body
    parent: np.ndarray  # [N] parent node, -1 for the world
    pairs: tuple[EdgePair, ...]  # of the joints


def topology(model: mujoco.MjModel) -> Topology:
    """Return the graph structure of a compiled model; bodies fixed to the world and mocap bodies belong to node 0."""
    weld = weld_roots(model)
    body = np.unique(weld).astype(np.int64)
    node_of_body = np.searchsorted(body, weld)
    parent = node_of_body[model.body_parentid[body]]
    parent[0] = -1
    pairs = []
    for joint, child in enumerate(node_of_body[model.jnt_bodyid].tolist()):
        kind = mujoco.mjtJoint(model.jnt_type[joint]).name.removeprefix("mjJNT_").lower()
        pairs.append(EdgePair(named(model, mujoco.mjtObj.mjOBJ_JOINT, joint), kind, int(parent[child]), child))
    return Topology(body, node_of_body, parent, tuple(pairs))


def weld_roots(model: mujoco.MjModel) -> np.ndarray:
    """Return the root ``[nbody]`` of each body's welded group; the world for mocap bodies."""
    return np.where(model.body_mocapid[model.body_weldid] >= 0, 0, model.body_weldid)


def named(model: mujoco.MjModel, kind: mujoco.mjtObj, element: int) -> str:
    """Return an element's name, or one made of its kind and number that no other element has."""
    if name := mujoco.mj_id2name(model, kind, int(element)):
        return name
    return free_name(
        f"{kind.name.removeprefix('mjOBJ_').lower()}{element}", lambda name: mujoco.mj_name2id(model, kind, name) >= 0
    )


def free_name(name: str, taken: Callable[[str], bool]) -> str:
    """Append underscores to a name until it is not ``taken``."""
    while taken(name):
        name += "_"
    return name


def offset(model: mujoco.MjModel, body: int, ancestor: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a body's position ``[3]`` and quaternion ``[4]`` in an ancestor's (or own) frame, joints at reference."""
    pos, quat = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    while body != ancestor:
        rotated, product = np.empty(3), np.empty(4)
        mujoco.mju_rotVecQuat(rotated, pos, model.body_quat[body])
        mujoco.mju_mulQuat(product, model.body_quat[body], quat)
        pos, quat = model.body_pos[body] + rotated, product
        body = int(model.body_parentid[body])
    return pos, quat


def in_node(model: mujoco.MjModel, graph: Topology, body: int, point: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
    """Return a body's node, and a body point ``[3]`` and the body's quaternion ``[4]`` in the node's frame."""
    node, rotated = int(graph.node_of_body[body]), np.empty(3)
    pos, quat = offset(model, body, int(graph.body[node]))
    mujoco.mju_rotVecQuat(rotated, point, quat)
    return node, pos + rotated, quat


def site_in_node(model: mujoco.MjModel, graph: Topology, site: int) -> tuple[int, np.ndarray, np.ndarray]:
    """Return a site's node, and its position ``[3]`` and quaternion ``[4]`` in the node's frame."""
    node, position, quat = in_node(model, graph, int(model.site_bodyid[site]), model.site_pos[site])
    orientation = np.empty(4)
    mujoco.mju_mulQuat(orientation, quat, model.site_quat[site])
    return node, position, orientation


@dataclass(frozen=True, eq=False)
class JointAnchors:
    """Anchors of hinges and balls, which join nodes into subtrees; the root of a subtree has none."""

    parent: np.ndarray  # [N] parent node; a root's is itself
    parent_anchor: np.ndarray  # [N, 3] anchor in the parent's frame, metres; 0 for a root
    child_anchor: np.ndarray  # [N, 3] anchor in the node's own frame, metres; 0 for a root
    ancestors: np.ndarray  # [N, N] 1 where the column's node is the row's or an ancestor of it, roots excluded
    root: np.ndarray  # [N] root of each node's subtree

    @property
    def anchor_scale(self) -> float:
        """Root mean square of the non-zero coordinates of the anchor offsets, metres; 1 without any."""
        offsets = np.concatenate((self.parent_anchor, self.child_anchor))
        return float(np.sqrt(np.mean(offsets[offsets != 0] ** 2))) if offsets.any() else 1.0


def find_joint_anchors(model: mujoco.MjModel, data: mujoco.MjData, graph: Topology) -> JointAnchors:
    """Find anchors of bodies whose joints are hinges and balls about one point; ``data`` must be at its reference."""
    count, rotational = len(graph.body), (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_BALL))
    parent, root = np.arange(count), np.arange(count)
    parent_anchor, child_anchor, ancestors = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, count))
    for node in range(1, count):
        body = int(graph.body[node])
        first = model.body_jntadr[body]
        joints = np.arange(first, first + model.body_jntnum[body])
        distance = np.abs(model.jnt_pos[joints] - model.jnt_pos[first]).max()
        if distance >= 1e-12 or not np.isin(model.jnt_type[joints], rotational).all():
            continue
        before = int(graph.parent[node])
        anchor, frame = data.xanchor[first], data.xmat[graph.body[before]].reshape(3, 3)
        parent[node], root[node] = before, root[before]
        parent_anchor[node] = frame.T @ (anchor - data.xpos[graph.body[before]])
        child_anchor[node] = model.jnt_pos[first]
        ancestors[node] = ancestors[before]
        ancestors[node, node] = 1
    return JointAnchors(parent, parent_anchor, child_anchor, ancestors, root)
