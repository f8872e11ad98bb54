"""Yaw frame: rotation of a scene, about gravity or about any axis, that leaves its dynamics unchanged."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from torchrl_gn.scenes.collisions import colliding_geoms
from torchrl_gn.scenes.invariance import (
    TOLERANCE,
    acts_on_position,
    actuators_of,
    depends_on_position,
    reference_rotation,
    surface_velocities,
)
from torchrl_gn.scenes.topology import Topology

_Disable, _Enable = mujoco.mjtDisableBit, mujoco.mjtEnableBit
_Transmission = mujoco.mjtTrn


@dataclass(frozen=True, eq=False)
class YawFrame:
    """Yaw of a rotation-invariant scene: the rotation of one root about a world axis.

    Without gravity and fixed surfaces nothing tells directions apart: the frame is the root's whole orientation.
    """

    exact: bool  # False if contacts depend on the yaw, which is then an input of the network
    node: int  # root node of the heaviest tree
    axis: int | None  # 0, 1 or 2 for the world's x, y or z; None: the whole orientation, as every axis is alike
    pivot: np.ndarray  # [3] a point on the axis, metres; 0 if every root can move across it
    rest: np.ndarray  # [4] the root's orientation at yaw 0

    @property
    def axes(self) -> tuple[int, ...]:
        """World axes that the scene can be rotated about."""
        return (0, 1, 2) if self.axis is None else (self.axis,)

    def about(self, axis: int) -> YawFrame:
        """Return the frame of rotations about ``axis`` alone, one of :attr:`axes`."""
        return replace(self, axis=axis)


def find_yaw_frame(model: mujoco.MjModel, data: mujoco.MjData, graph: Topology, movable: np.ndarray) -> YawFrame | None:
    """Find the yaw frame of a scene; None if its dynamics depend on the yaw other than through contacts.

    Every root must have a free joint, or slides (or none) and then a ball or a hinge about the axis. Roots that cannot
    move across the axis must pivot on it. Gravity and wind must be parallel to it. No limit, spring, tendon, equality
    constraint or position actuator may depend on those joints or on the world. Motion across the axis must be isotropic
    and without motors. If all this holds about every axis, and for contacts too, the frame has no axis: rotations about
    two axes make all others. ``data`` must be at its reference, kinematics done.
    """
    if model.nplugin or model.nflex:
        return None
    about = (_yaw_frame_about(model, data, graph, movable, axis) for axis in (2, 0, 1))
    frames = [frame for frame in about if frame is not None]
    if len(frames) == 3 and all(frame.exact for frame in frames):
        return replace(frames[0], axis=None)
    return frames[0] if frames else None


def _yaw_frame_about(
    model: mujoco.MjModel, data: mujoco.MjData, graph: Topology, movable: np.ndarray, axis: int
) -> YawFrame | None:
    across = [index for index in range(3) if index != axis]
    flow = model.opt.wind if model.opt.density or model.opt.viscosity else np.zeros(3)
    weight = np.zeros(3) if model.opt.disableflags & _Disable.mjDSBL_GRAVITY else model.opt.gravity
    one, other = movable.reshape(len(movable), 4, 3)[..., across].T
    if np.abs([flow[across], weight[across]]).max() > TOLERANCE or (one != other).any():
        return None
    roots, joints, pivots = np.flatnonzero(graph.parent == 0), set(), []
    for body in graph.body[roots]:
        joints_and_end = _rotating_joints(model, int(body), axis)
        if joints_and_end is None or any(depends_on_position(model, joint) for joint in joints_and_end[0]):
            return None
        joints |= joints_and_end[0]
        if not joints_and_end[1]:
            pivots.append(data.xanchor[int(model.body_jntadr[body] + model.body_jntnum[body] - 1)].copy())
    pivot = pivots[0] if pivots else np.zeros(3)
    if any(np.abs((each - pivot)[across]).max() > TOLERANCE for each in pivots):
        return None
    if acts_on_position(model, graph, joints):
        return None
    node = int(roots[model.body_subtreemass[graph.body[roots]].argmax()])
    rest_quat = np.empty(4)
    mujoco.mju_mat2Quat(rest_quat, reference_rotation(model, int(graph.body[node])).ravel())
    return YawFrame(not contacts_depend_on_yaw(model, data, graph, axis), node, axis, pivot, rest_quat)


def _rotating_joints(model: mujoco.MjModel, body: int, axis: int) -> tuple[set[int], bool] | None:
    """Return the joints that rotate a root about a world axis or move it across, and whether any move it across.

    None if the root cannot rotate about the axis, or if its motion across is in one direction only, anisotropic or
    driven by a motor.
    """
    kind, across = mujoco.mjtJoint, [index for index in range(3) if index != axis]
    first = int(model.body_jntadr[body])
    *slides, last = range(first, first + int(model.body_jntnum[body]))
    axes = model.jnt_axis[first : last + 1] @ reference_rotation(model, body).T  # [joints, 3] at the reference
    rotates = {kind.mjJNT_FREE: True, kind.mjJNT_BALL: True, kind.mjJNT_HINGE: abs(axes[-1, axis]) > 1 - TOLERANCE}
    if not rotates.get(kind(model.jnt_type[last])) or (model.jnt_type[slides] != kind.mjJNT_SLIDE).any():
        return None
    lateral = [slide for slide in slides if abs(axes[slide - first, axis]) < 1 - TOLERANCE]
    if model.jnt_type[last] == kind.mjJNT_FREE:
        directions, dofs = np.eye(2), model.jnt_dofadr[last] + np.array(across)
    else:
        directions, dofs = axes[[slide - first for slide in lateral]][:, across], model.jnt_dofadr[lateral]
    if len(dofs):
        orthonormal = directions.shape == (2, 2) and np.abs(directions @ directions.T - np.eye(2)).max() <= TOLERANCE
        if not orthonormal or not _isotropic(model, dofs) or len(actuators_of(model, *lateral)):
            return None
    if _pushes_across(model, last, across):
        return None
    return {*lateral, last}, bool(len(dofs))


def _pushes_across(model: mujoco.MjModel, joint: int, across: list[int]) -> bool:
    """Return True if a motor of a free joint or ball acts in a world direction across the axis."""
    free = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
    if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
        return False
    for actuator in actuators_of(model, joint):
        # Forces on a free joint act along the world's axes, torques about the body's own, or the parent's.
        forces, torques = np.split(model.actuator_gear[actuator], [3 if free else 0])
        in_parent = model.actuator_trntype[actuator] == _Transmission.mjTRN_JOINTINPARENT
        if free and forces[across].any() or in_parent and torques[across].any():
            return True
    return False


def _isotropic(model: mujoco.MjModel, dofs: np.ndarray) -> bool:
    """Return True if passive forces on orthogonal degrees of freedom are the same in all directions."""
    linear = all(np.ptp(getattr(model, name)[dofs]) == 0 for name in ("dof_damping", "dof_armature"))
    polynomial = getattr(model, "dof_dampingpoly", np.zeros((model.nv, 1)))  # since MuJoCo 3.7
    return bool(linear and not polynomial[dofs].any() and not model.dof_frictionloss[dofs].any())


def contacts_depend_on_yaw(model: mujoco.MjModel, data: mujoco.MjData, graph: Topology, axis: int) -> bool:
    """Return True if a rotation of the scene about a world axis changes contact forces, beyond rotating them.

    They change if a moving geom can touch a fixed one, except a plane across the axis whose surface does not move. They
    also change with friction pyramids or unequal friction coefficients, whose directions follow the world axes; those
    of a capsule on a plane follow the capsule.
    """
    pairs = _colliding_pairs(model, graph)
    kind, plane = model.geom_type, int(mujoco.mjtGeom.mjGEOM_PLANE)
    still = ~surface_velocities(model).any(1)
    across = still & (kind == plane) & (np.abs(np.abs(data.geom_xmat[:, 2::3][:, axis]) - 1) < TOLERANCE)
    fixed = graph.node_of_body[model.geom_bodyid] == 0
    pyramids = model.opt.cone == int(mujoco.mjtCone.mjCONE_PYRAMIDAL)
    for first, second, size, friction in pairs:
        if any(fixed[each] and not across[each] for each in (first, second)):
            return True
        along_capsule = sorted((kind[first], kind[second])) == [plane, int(mujoco.mjtGeom.mjGEOM_CAPSULE)]
        uneven = friction[0] != friction[1] or (size > 4 and friction[3] != friction[4])
        if size > 1 and not along_capsule and (pyramids or uneven):
            return True
    return False


def _colliding_pairs(model: mujoco.MjModel, graph: Topology) -> Iterator[tuple[int, int, int, np.ndarray]]:
    """Yield pairs of geoms that can collide, their contact's dimension and five coefficients of friction."""
    override = model.opt.o_friction if model.opt.enableflags & int(_Enable.mjENBL_OVERRIDE) else None
    node, colliding = graph.node_of_body[model.geom_bodyid], np.triu(colliding_geoms(model))
    if not colliding.any():
        return
    for index, pair in enumerate(zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)):
        first, second = sorted(pair)
        colliding[first, second] = False
        if node[first] or node[second]:
            friction = model.pair_friction[index] if override is None else override
            yield first, second, int(model.pair_dim[index]), friction
    for first, second in np.argwhere(colliding).tolist():
        size, priority = model.geom_condim[[first, second]], model.geom_priority[[first, second]]
        yield first, second, int(size[priority == priority.max()].max()), np.zeros(5) if override is None else override
