"""The world axis about which a whole scene can be turned without changing its dynamics."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_gn.scenes.invariance import feels_position, reference_rotation, tied, touches_world
from torchrl_gn.scenes.topology import Topology

_TOLERANCE = 1e-9
_Disable = mujoco.mjtDisableBit


@dataclass(frozen=True, eq=False)
class YawFrame:
    """Where a rotation-invariant scene faces: the turn of its root about ``axis``.

    Attributes:
        exact: whether nothing at all depends on the yaw_frame; if not, moving parts can touch
            something fixed in the world, and only that depends on it.
        node: the root node, whose turn is the yaw_frame.
        axis: 0, 1 or 2 for the world's x, y or z.
        pivot: ``[3]`` a point on the axis, metres; 0 where the scene can be shifted too.
        rest: ``[4]`` the root's orientation at yaw_frame 0.
    """

    exact: bool
    node: int
    axis: int
    pivot: np.ndarray
    rest: np.ndarray


def find_yaw_frame(
    model: mujoco.MjModel, data: mujoco.MjData, graph: Topology, movable: np.ndarray, translation_invariant: np.ndarray
) -> YawFrame | None:
    """The world axis about which the dynamics, contacts with the world apart, can be turned.

    Found for one tree that hangs from the world by a hinge about the axis (a swimmer's
    yaw_frame, an arm's base), perhaps after slides, if gravity and wind are parallel to the
    axis, neither limit, spring, tendon, equality constraint nor position actuator feels the
    turn, and slides across the axis are alike and without motors. A free joint has no yaw_frame
    that is defined in every orientation.

    Args:
        model: the scene's model.
        data: of that model at its reference, kinematics done.
        graph: its topology.
        movable: ``[N, 12]`` bool, components of the state change that can differ from zero.
        translation_invariant: ``[3]`` bool.
    """
    roots = np.flatnonzero(graph.parent == 0)
    if len(roots) != 1 or model.nplugin or model.nflex:
        return None
    node = int(roots[0])
    body = int(graph.body[node])
    slides, hinge = _slides_then_hinge(model, body)
    if hinge is None or feels_position(model, hinge):
        return None
    rest = reference_rotation(model, body)
    directions = np.abs(rest @ model.jnt_axis[hinge])
    axis = int(directions.argmax())
    if abs(directions[axis] - 1) > _TOLERANCE:
        return None
    across = [index for index in range(3) if index != axis]
    flow = model.opt.wind if model.opt.density or model.opt.viscosity else np.zeros(3)
    weight = np.zeros(3) if model.opt.disableflags & _Disable.mjDSBL_GRAVITY else model.opt.gravity
    if np.abs(flow[across]).max() > _TOLERANCE or np.abs(weight[across]).max() > _TOLERANCE:
        return None
    moved = [slide for slide in slides if abs((rest @ model.jnt_axis[slide])[axis]) < 1 - _TOLERANCE]
    if moved and not (_alike(model, moved, rest, across) and translation_invariant[across].all()):
        return None
    if any(tied(model, graph, {hinge, *moved})):
        return None
    vectors = movable.reshape(len(movable), 4, 3)
    if not np.array_equal(vectors[..., across[0]], vectors[..., across[1]]):
        return None
    pivot = np.zeros(3) if moved else data.xanchor[hinge].copy()
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, rest.ravel())
    return YawFrame(not touches_world(model, data, graph, None), node, axis, pivot, quat)


def _slides_then_hinge(model: mujoco.MjModel, body: int) -> tuple[list[int], int | None]:
    """The slides that a body's joints begin with, and the hinge after them if it is the last."""
    joints = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
    kinds = [mujoco.mjtJoint(model.jnt_type[joint]) for joint in joints]
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    if not kinds or kinds[-1] != hinge or any(kind != slide for kind in kinds[:-1]):
        return [], None
    return list(joints)[:-1], joints[-1]


def _alike(model: mujoco.MjModel, slides: list[int], rest: np.ndarray, across: list[int]) -> bool:
    """Whether slides move freely, and equally, over the whole plane across the axis."""
    directions = np.array([(rest @ model.jnt_axis[slide])[across] for slide in slides])
    if directions.shape != (2, 2) or np.abs(directions @ directions.T - np.eye(2)).max() > _TOLERANCE:
        return False
    if np.isin(model.actuator_trnid[:, 0], slides).any():
        return False
    dofs = model.jnt_dofadr[slides]
    names = ("dof_damping", "dof_dampingpoly", "dof_armature", "dof_frictionloss")
    table = [getattr(model, name) for name in names if hasattr(model, name)]  # MuJoCo before 3.7 has no polynomials
    return all(np.array_equal(values[dofs[0]], values[dofs[1]]) for values in table)
