"""Yaw frames: the world axis about which a scene can rotate without changing its dynamics."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_gn.scenes.invariance import acts_on_position, collides_with_world, depends_on_position, reference_rotation
from torchrl_gn.scenes.topology import Topology

_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class YawFrame:
    """Yaw of a rotation-invariant scene: the rotation of its root about a world axis."""

    exact: bool  # False if moving geoms can touch fixed ones, so that contacts depend on the yaw
    node: int  # root node
    axis: int  # 0, 1 or 2 for the world's x, y or z
    pivot: np.ndarray  # [3] a point on the axis, metres; 0 if the scene is translation-invariant across it
    rest: np.ndarray  # [4] the root's orientation at yaw 0


def find_yaw_frame(
    model: mujoco.MjModel, data: mujoco.MjData, graph: Topology, movable: np.ndarray, translation_invariant: np.ndarray
) -> YawFrame | None:
    """Yaw frame of a scene, or None if its dynamics depend on the yaw other than by contacts.

    The scene must be one tree whose root has slides, if any, then a hinge about a world axis. Gravity and wind must be
    parallel to that axis. No limit, spring, tendon, equality constraint or position actuator may depend on the hinge,
    and slides across the axis must be alike and without motors. ``data`` must be at its reference, kinematics done.
    """
    roots = np.flatnonzero(graph.parent == 0)
    if len(roots) != 1 or model.nplugin or model.nflex:
        return None
    node = int(roots[0])
    body = int(graph.body[node])
    slides, hinge = _slides_then_hinge(model, body)
    if hinge is None or depends_on_position(model, hinge):
        return None
    rest = reference_rotation(model, body)
    directions = np.abs(rest @ model.jnt_axis[hinge])
    axis = int(directions.argmax())
    if abs(directions[axis] - 1) > _TOLERANCE:
        return None
    across = [index for index in range(3) if index != axis]
    flow = model.opt.wind if model.opt.density or model.opt.viscosity else np.zeros(3)
    weight = np.zeros(3) if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY else model.opt.gravity
    if np.abs(flow[across]).max() > _TOLERANCE or np.abs(weight[across]).max() > _TOLERANCE:
        return None
    lateral = [slide for slide in slides if abs((rest @ model.jnt_axis[slide])[axis]) < 1 - _TOLERANCE]
    if lateral and not (_isotropic(model, lateral, rest, across) and translation_invariant[across].all()):
        return None
    if acts_on_position(model, graph, {hinge, *lateral}):
        return None
    vectors = movable.reshape(len(movable), 4, 3)
    if not np.array_equal(vectors[..., across[0]], vectors[..., across[1]]):
        return None
    pivot = np.zeros(3) if lateral else data.xanchor[hinge].copy()
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, rest.ravel())
    return YawFrame(not collides_with_world(model, data, graph, None), node, axis, pivot, quat)


def _slides_then_hinge(model: mujoco.MjModel, body: int) -> tuple[list[int], int | None]:
    """Slides that a body's joints begin with, and the hinge that must end them; else no slide and None."""
    joints = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
    kinds = [mujoco.mjtJoint(model.jnt_type[joint]) for joint in joints]
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    if not kinds or kinds[-1] != hinge or any(kind != slide for kind in kinds[:-1]):
        return [], None
    return list(joints)[:-1], joints[-1]


def _isotropic(model: mujoco.MjModel, slides: list[int], rest: np.ndarray, across: list[int]) -> bool:
    """Whether slides span the plane across the axis orthogonally, with equal passive forces and no motors."""
    directions = np.array([(rest @ model.jnt_axis[slide])[across] for slide in slides])
    if directions.shape != (2, 2) or np.abs(directions @ directions.T - np.eye(2)).max() > _TOLERANCE:
        return False
    if np.isin(model.actuator_trnid[:, 0], slides).any():
        return False
    dofs = model.jnt_dofadr[slides]
    names = ("dof_damping", "dof_dampingpoly", "dof_armature", "dof_frictionloss")
    table = [getattr(model, name) for name in names if hasattr(model, name)]  # MuJoCo before 3.7 has no dampingpoly
    return all(np.array_equal(values[dofs[0]], values[dofs[1]]) for values in table)
