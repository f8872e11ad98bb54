"""Simulated invariance: accelerations must rotate with a scene that is shifted or rotated as a whole."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import mujoco
import numpy as np

from torchrl_gn.scenes.collisions import colliding_geoms
from torchrl_gn.scenes.messages import quiet_mujoco
from torchrl_gn.scenes.topology import Topology, offset
from torchrl_gn.scenes.yaw_frame import YawFrame

_JOINT = mujoco.mjtJoint
_STATES, _LARGE = 4, 60  # states compared; half as many from 60 degrees of freedom on
_SMOOTH, _CONTACT = 1e-5, 1e-3  # largest relative difference without contacts, and with them
_SHIFT, _ANGLE = 1.7, 0.83  # metres, radians
_TINY = 1e-6  # N, a force
_SLIPPERY, _SHALLOW = 0.1, 0.2  # factor of friction, up to a depth of contacts in metres
# Distance from the world at which bodies touch it here, relative to the scene's extent; planes reach farther.
_REACH = 0.2


@dataclass(frozen=True, eq=False)
class Motion:
    """A rigid motion of a whole scene: a rotation about a world axis through ``pivot``, then a shift."""

    shift: np.ndarray  # [3] metres
    axis: int = 2  # 0, 1 or 2 for the world's x, y or z
    angle: float = 0.0  # radians
    pivot: np.ndarray | None = None  # [3] metres; None: the origin

    @property
    def quaternion(self) -> np.ndarray:
        quat = np.zeros(4)
        quat[0], quat[1 + self.axis] = np.cos(self.angle / 2), np.sin(self.angle / 2)
        return quat

    @property
    def matrix(self) -> np.ndarray:
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, self.quaternion)
        return matrix.reshape(3, 3)

    def place(self, point: np.ndarray) -> np.ndarray:
        """Return a world point ``[3]`` after the motion."""
        pivot = np.zeros(3) if self.pivot is None else self.pivot
        return self.matrix @ (point - pivot) + pivot + self.shift


def confirmed(
    model: mujoco.MjModel, graph: Topology, invariant: np.ndarray, yaw_frame: YawFrame | None
) -> tuple[np.ndarray, YawFrame | None]:
    """Keep the axes of translation invariance ``[3]`` and the yaw frame only as far as simulation confirms them."""

    def fails(motion: Motion, *, contacts: bool) -> bool:
        return changes_dynamics(model, graph, motion, contacts=contacts)

    shifts = [Motion(_SHIFT * axis) for axis in np.eye(3)]
    confirmed = [
        bool(holds) and not any(fails(shift, contacts=contacts) for contacts in (False, True))
        for holds, shift in zip(invariant, shifts, strict=True)
    ]
    frames = [] if yaw_frame is None else [_confirmed_about(yaw_frame.about(axis), fails) for axis in yaw_frame.axes]
    if yaw_frame is not None and not all(frame is not None and frame.exact == yaw_frame.exact for frame in frames):
        yaw_frame = next((frame for frame in reversed(frames) if frame is not None), None)  # z before y and x
    return np.array(confirmed), yaw_frame


def _confirmed_about(frame: YawFrame, fails: Callable[..., bool]) -> YawFrame | None:
    """Confirm a yaw frame with one axis; None if it fails without contacts, not exact if it fails with contacts."""
    assert frame.axis is not None
    turn = Motion(np.zeros(3), frame.axis, _ANGLE, frame.pivot)
    if fails(turn, contacts=False):
        return None
    return replace(frame, exact=frame.exact and not fails(turn, contacts=True))


def changes_dynamics(model: mujoco.MjModel, graph: Topology, motion: Motion, *, contacts: bool) -> bool:
    """Return True if moving the whole scene changes its accelerations, beyond rotating them, in a few states.

    Every root must have a free joint, or slides that can make the motion (or none) and then a ball or a hinge about its
    axis. Without contacts, a difference in any state counts. With contacts, most of the states with active contacts
    must differ, as rounding breaks ties there.
    """
    model = _precise(model, graph, contacts)
    rng, data, moves = np.random.default_rng(0), mujoco.MjData(model), _RootMoves(model, graph, motion)
    differ = compared = 0
    with quiet_mujoco():
        for _ in range(_STATES if model.nv < _LARGE else _STATES // 2):
            position, velocity, *held = _random_state(model, rng)
            before = _acceleration(model, data, position, velocity, *held)
            touches = _pushes(data)
            after = _acceleration(model, data, moves.position(position), moves.velocity(velocity), *held)
            touches |= _pushes(data)
            size = max(np.abs(before).max(), np.abs(after).max()) + 1e-3
            if np.isfinite(size) and (touches or not contacts):
                away = np.abs(after - moves.velocity(before)).max()
                differ += bool(away > (_CONTACT if contacts else _SMOOTH) * size)
                compared += 1
    return 2 * differ > compared if contacts else differ > 0


def _precise(model: mujoco.MjModel, graph: Topology, contacts: bool) -> mujoco.MjModel:
    """Copy the model for exact solves, without contacts or with contact margins that reach the world."""
    model = copy.copy(model)
    model.opt.iterations, model.opt.tolerance = 200, 0.0
    if getattr(model, "nhistory", 0):
        model.actuator_history[:, 0] = 0  # controls act at once
    if contacts:
        fixed = graph.node_of_body[model.geom_bodyid] == 0
        reach = _REACH * model.stat.extent + _heights(model, fixed)
        model.geom_margin[fixed] += reach[fixed]
        model.pair_margin[:] += reach[[model.pair_geom1, model.pair_geom2]].max(0)
        model.opt.o_margin += reach.max(initial=0.0)  # of all contacts, if the model overrides theirs
        for friction in (model.geom_friction, model.pair_friction, model.opt.o_friction):
            # Sticking contacts hide the direction of friction; deep ones stick more.
            friction[:] *= _SLIPPERY * np.clip(_SHALLOW / (_REACH * model.stat.extent), 0.05, 1.0)
    else:
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    return model


def _heights(model: mujoco.MjModel, fixed: np.ndarray) -> np.ndarray:
    """Return the height ``[G]`` of the lowest geom that can touch each fixed plane, at the reference; else 0."""
    heights, colliding, data = np.zeros(model.ngeom), colliding_geoms(model), mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for plane in np.flatnonzero(fixed & (model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE))):
        above = (data.geom_xpos[colliding[plane]] - data.geom_xpos[plane]) @ data.geom_xmat[plane, 2::3]
        heights[plane] = max(above.min(), 0.0) if len(above) else 0.0
    return heights


class _Root(NamedTuple):
    """Joints of a tree's root."""

    slides: list[int]  # slides before any other joint
    other: int | None  # first joint that is not a slide; later joints turn with it
    directions: np.ndarray  # [3, slides] of the slides, world frame
    inverse: np.ndarray  # [slides, 3] pseudo-inverse of directions
    anchor: np.ndarray  # [3] point that the slides move, world frame, at the reference
    rest: np.ndarray  # [4] orientation at the reference
    turn: float  # of a hinge, relative to the scene's rotation


class _RootMoves:
    """Coordinates and rates of the trees' roots after a motion."""

    def __init__(self, model: mujoco.MjModel, graph: Topology, motion: Motion) -> None:
        self.model, self.motion = model, motion
        self.quaternion, self.matrix = motion.quaternion, motion.matrix
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        self.roots = [self._root(body, data.xanchor) for body in graph.body[graph.parent == 0].tolist()]

    def _root(self, body: int, anchors: np.ndarray) -> _Root:
        model, rest_quat = self.model, offset(self.model, body, 0)[1]
        first = int(model.body_jntadr[body])
        joints = list(range(first, first + int(model.body_jntnum[body])))
        other = next((joint for joint in joints if model.jnt_type[joint] != int(_JOINT.mjJNT_SLIDE)), None)
        slides = [joint for joint in joints if other is None or joint < other]
        axes = np.empty((len(joints), 3))
        for row, joint in zip(axes, joints, strict=True):
            mujoco.mju_rotVecQuat(row, model.jnt_axis[joint], rest_quat)
        directions = axes[: len(slides)].T
        anchor = anchors[slides[-1] if other is None else other].copy()
        turn = 0.0 if other is None else float(axes[other - first, self.motion.axis])
        return _Root(slides, other, directions, np.linalg.pinv(directions), anchor, rest_quat, turn)

    def position(self, position: np.ndarray) -> np.ndarray:
        """Return ``qpos`` after the motion."""
        model, motion, moved = self.model, self.motion, position.copy()
        for root in self.roots:
            if root.slides:
                at = model.jnt_qposadr[root.slides]
                point = root.anchor + root.directions @ (position[at] - model.qpos0[at])
                moved[at] = model.qpos0[at] + root.inverse @ (motion.place(point) - root.anchor)
            if root.other is None:
                continue
            first, kind = int(model.jnt_qposadr[root.other]), _JOINT(model.jnt_type[root.other])
            if kind == _JOINT.mjJNT_FREE:
                moved[first : first + 3] = motion.place(position[first : first + 3])
                moved[first + 3 : first + 7] = _product(self.quaternion, position[first + 3 : first + 7])
            elif kind == _JOINT.mjJNT_BALL:
                turned = _product(self.quaternion, _product(root.rest, position[first : first + 4]))
                moved[first : first + 4] = _product(root.rest * [1, -1, -1, -1], turned)
            else:
                moved[first] += motion.angle * root.turn
        return moved

    def velocity(self, velocity: np.ndarray) -> np.ndarray:
        """Return ``qvel`` or ``qacc`` after the motion."""
        model, rotated = self.model, velocity.copy()
        for root in self.roots:
            if root.slides:
                at = model.jnt_dofadr[root.slides]
                rotated[at] = root.inverse @ (self.matrix @ (root.directions @ velocity[at]))
            if root.other is not None and model.jnt_type[root.other] == int(_JOINT.mjJNT_FREE):
                first = int(model.jnt_dofadr[root.other])  # its angular part is in the body's own frame
                rotated[first : first + 3] = self.matrix @ velocity[first : first + 3]
        return rotated


def _random_state(model: mujoco.MjModel, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Draw coordinates near the reference, rates, activations and controls."""
    position, change = model.qpos0.copy(), 0.3 * rng.normal(size=model.nv)
    for joint in np.flatnonzero(model.jnt_type == int(_JOINT.mjJNT_FREE)):
        first = int(model.jnt_dofadr[joint])
        change[first : first + 3] *= 0.2 * model.stat.extent
    mujoco.mj_integratePos(model, position, change, 1.0)
    low, high = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-1.0, 1.0]).T
    return position, rng.normal(size=model.nv), rng.uniform(size=model.na), rng.uniform(low, high)


def _acceleration(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    position: np.ndarray,
    velocity: np.ndarray,
    activation: np.ndarray,
    control: np.ndarray,
) -> np.ndarray:
    """Return ``qacc`` of a state; ``data`` holds its contact forces afterwards."""
    mujoco.mj_resetData(model, data)
    data.qpos[:], data.qvel[:], data.act[:], data.ctrl[:] = position, velocity, activation, control
    mujoco.mj_forward(model, data)
    return data.qacc.copy()


def _pushes(data: mujoco.MjData) -> bool:
    """Return True if some contact exerts a force."""
    is_contact = data.efc_type >= int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)
    return bool((np.abs(data.efc_force[is_contact]) > _TINY).any())


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    product = np.empty(4)
    mujoco.mju_mulQuat(product, a, b)
    return product
