"""Joint coordinates and rates from a scene's body states."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchrl_gn.maths import quaternion
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.quaternion import turned_by
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.scenes.force_elements import JOINT_GROUPS, gimbal_lock, joint_constants, joint_groups, joint_poses
from torchrl_gn.scenes.scene import Scene, UnsupportedSceneError

_HINGE, _SLIDE, _BALL, _FREE = (
    int(getattr(mujoco.mjtJoint, f"mjJNT_{name}")) for name in ("HINGE", "SLIDE", "BALL", "FREE")
)
_LENGTHS = {_HINGE: (1, 1), _SLIDE: (1, 1), _BALL: (4, 3), _FREE: (7, 6)}  # numbers of a joint in qpos and qvel
_TINY = 1e-12  # keeps square roots and quotients differentiable in the gimbal lock of three hinges
_SHORT = 1e-9  # a length, which does the same: it is the square of the distance from gimbal lock, in radians
_REST = 1e-10  # a squared sine, which does the same for a ball in its reference pose


class JointStates(NamedTuple):
    """Coordinates of all joints of a scene; 0 for joints whose coordinates do not follow from body states."""

    sine: Tensor  # [*B, J] sine of a hinge's or ball's angle from the reference pose; 0 for a slide
    cosine: Tensor  # [*B, J] cosine of the same angle
    coordinate: Tensor  # [*B, J] MuJoCo's coordinate of a hinge or slide, the angle of a ball; rad or m
    rate: Tensor  # [*B, J] rate of the coordinate, rad/s or m/s


class JointCoordinates(Float64Buffers):
    """Coordinates and rates of joints from body states, differentiable.

    Covers the bodies whose joints :func:`~torchrl_gn.scenes.force_elements.joint_groups` knows. Bodies determine a
    hinge's angle up to whole turns: the result is the angle nearest to the unwrapped one in the state, if the state
    holds one (``Scene.unwrapped``), else nearest to the middle of the hinge's range. Bodies determine the angles of
    three hinges up to their mirror image beyond gimbal lock, too: the state holds these angles if the middle hinge can
    pass gimbal lock, else its angle is in the half turn that holds the middle of its range. States that violate the
    joints give the coordinates of a state nearby.

    Args:
        scene: the scene.
        partly: skip joints of other bodies (see :attr:`known`) instead of refusing the scene.

    Raises:
        UnsupportedSceneError: if coordinates of some joints, which the message names, do not follow from body states.
    """

    known: Tensor  # [J] bool
    parent: Tensor
    pose: Tensor
    joint: Tensor
    start: Tensor
    middle: Tensor
    branch: Tensor
    to_joints: Tensor
    to_position: Tensor
    to_velocity: Tensor
    winds: Tensor
    angle: Tensor
    node: Tensor
    channel: Tensor

    def __init__(self, scene: Scene, *, partly: bool = False) -> None:
        super().__init__()
        model = scene.model
        groups, others = joint_groups(model, scene.body)
        if others and not partly:
            names = [scene.joint_names[joint] for joint in others]
            raise UnsupportedSceneError(
                f"The coordinates of joints {names} of scene {scene.name!r} do not follow from body states here: a"
                " body may have a free joint, or independent slides, then up to three hinges of which no two in a"
                " row are parallel, or a ball."
            )
        order = [joint for name in JOINT_GROUPS for _, some in groups[name] for joint in some]
        scalars = len(order) - len(groups["free"])
        # All other joints read a 0 that is appended to the joints found.
        to_joints = np.full(model.njnt, scalars)
        to_joints[order[:scalars]] = np.arange(scalars)
        places = [
            [int(address[joint]) + i for joint in order for i in range(_LENGTHS[int(model.jnt_type[joint])][which])]
            for which, address in enumerate((model.jnt_qposadr, model.jnt_dofadr))
        ]
        start = model.qpos0[model.jnt_qposadr] * np.isin(model.jnt_type, (_HINGE, _SLIDE))
        middle = np.where(model.jnt_limited.astype(bool), model.jnt_range.mean(1), start)
        self.groups = tuple(name for name, found in groups.items() if found)  # torch.export saves no empty tensors
        for name in self.groups:
            found = groups[name]
            at = torch.tensor([node for node, _ in found], dtype=torch.long)
            joints = torch.tensor([some for _, some in found], dtype=torch.long).reshape(len(found), JOINT_GROUPS[name])
            self.constants({f"{name}_node": at, f"{name}_joints": joints})
        if groups["three"]:
            branches = [_branch(model, some, middle - start) for _, some in groups["three"]]
            self.constants({"branch": np.array(branches)})
        self.constants(
            {
                "known": torch.from_numpy(to_joints < scalars),
                "parent": np.maximum(scene.parent, 0),
                "pose": joint_poses(scene),
                "joint": joint_constants(scene)[: 2 * model.njnt : 2],
                "start": start,
                "middle": middle,
                "to_joints": to_joints,
                "to_position": np.argsort(places[0]),
                "to_velocity": np.argsort(places[1]),
            }
        )
        unwrapped, count = scene.unwrapped, len(scene.unwrapped.joint)
        self.any_winds = count > 0
        self.any_locks = bool(np.isin([some[1] for _, some in groups["three"]], unwrapped.joint).any())
        if not self.any_winds:  # torch.export saves no empty tensors
            return
        angle = np.full(model.njnt, count)
        angle[unwrapped.joint] = np.arange(count)
        channel = scene.state_size - unwrapped.size + unwrapped.slot
        self.constants({"winds": angle < count, "angle": angle, "node": unwrapped.node, "channel": channel})

    def _of(self, name: str) -> tuple[Tensor, Tensor]:
        """Return the nodes ``[K]`` of a group and their joints ``[K, n]``."""
        return getattr(self, f"{name}_node"), getattr(self, f"{name}_joints")

    def joints(
        self, state: Tensor, matrices: Tensor, pose: Tensor | None = None, joint: Tensor | None = None
    ) -> JointStates:
        """Compute the joints of states ``[*B, N, 13]`` with rotation matrices ``[*B, N, 3, 3]``.

        ``pose`` ``[*B, N, 7]`` and ``joint`` ``[*B, J, 8]``, one row per joint, are ``joint_pose`` and ``joint`` of
        :class:`PhysicalParameters`; default: the scene's.
        """
        pose = (self.pose if pose is None else pose).to(state.dtype)
        joint = (self.joint if joint is None else joint).to(state.dtype)
        position, _, linear, angular = (state[..., where] for where in BODY_STATE.slices.values())
        above = matrices[..., self.parent, :, :]
        frame = above @ quaternion.to_matrix(pose[..., 3:]).unflatten(-1, (3, 3))
        relative = frame.mT @ matrices
        turning = angular - angular[..., self.parent, :]
        spin = turned_by(matrices.mT, turning)
        parts: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []

        if "slide" in self.groups:
            at, which = self._of("slide")
            axis, anchor = (joint[..., which[:, 0], part] for part in (slice(3), slice(3, 6)))
            arm = turned_by(matrices[..., at, :, :], anchor)
            up = self.parent[at]
            moved = position[..., at, :] - position[..., up, :] - turned_by(above[..., at, :, :], pose[..., at, :3])
            to_frame = frame[..., at, :, :].mT
            displacement = turned_by(to_frame, moved + arm) - anchor
            # Remove the velocity due to the parent's rotation; add the anchor's due to the body's own rotation.
            carried = torch.linalg.cross(angular[..., up, :], position[..., at, :] - position[..., up, :])
            rate = linear[..., at, :] - linear[..., up, :] - carried
            rate = turned_by(to_frame, rate + torch.linalg.cross(turning[..., at, :], arm))
            coordinate = (displacement * axis).sum(-1) + self.start[which[:, 0]].to(state.dtype)
            parts.append(
                (torch.zeros_like(coordinate), torch.zeros_like(coordinate), coordinate, (rate * axis).sum(-1))
            )

        for name, hinges in (("one", _one_hinge), ("two", _two_hinges), ("three", _three_hinges)):
            if name in self.groups:
                at, which = self._of(name)
                axes = [joint[..., each, :3] for each in which.unbind(-1)]
                branches = [()] if name != "three" else [(self.branch,), (-self.branch,)][: 1 + self.any_locks]
                each_branch = [
                    _columns(hinges(relative[..., at, :, :], spin[..., at, :], *axes, *branch)) for branch in branches
                ]
                found = each_branch[0] if len(each_branch) == 1 else self._nearer(*each_branch, which, state)
                sine, cosine, rate = (each.flatten(-2) for each in found)
                coordinate = self._angles(sine, cosine, which.flatten())
                parts.append((sine, cosine, coordinate, rate))

        if "ball" in self.groups:
            at = self._of("ball")[0]
            twice, cosine = _twice_sine_axis(relative[..., at, :, :]), _cosine(relative[..., at, :, :])
            sine = (0.25 * twice.square().sum(-1) + _REST).sqrt()
            rate = 0.5 * (twice * spin[..., at, :]).sum(-1) / sine
            parts.append((sine, cosine, torch.atan2(sine, cosine), rate))

        none = state.new_zeros((*state.shape[:-2], 1))
        columns = zip(*parts, strict=True) if parts else ((),) * 4
        found = JointStates(*(torch.cat((*column, none), dim=-1)[..., self.to_joints] for column in columns))
        return self._unwrapped(found, state) if self.any_winds else found

    def _unwrapped(self, found: JointStates, state: Tensor) -> JointStates:
        """Replace angles by the equivalent ones nearest to the unwrapped angles in the state."""
        held = self._held(state)
        away = found.coordinate - held
        nearest = held + torch.atan2(away.sin(), away.cos())
        return found._replace(coordinate=torch.where(self.winds, nearest, found.coordinate))

    def _held(self, state: Tensor) -> Tensor:
        """Return the unwrapped angles ``[*B, J]`` in the state, 0 of joints without."""
        return pad(state[..., self.node, self.channel], (0, 1))[..., self.angle]

    def _nearer(self, one: _Hinge, other: _Hinge, which: Tensor, state: Tensor) -> _Hinge:
        """Choose the nearer one to the unwrapped angles in the state of two solutions ``[*B, K, 3]`` for three hinges.

        The first one holds for hinges whose angles the state does not hold.
        """
        held = self._held(state)[..., which] - self.start[which].to(state.dtype)
        # Differences of the cosines of the distances.
        gain = ((other[1] - one[1]) * held.cos() + (other[0] - one[0]) * held.sin()).sum(-1, keepdim=True)
        nearer = torch.where(self.winds[which[:, 1:2]], gain, 0.0) > 0
        sine, cosine, rate = (torch.where(nearer, theirs, ours) for ours, theirs in zip(one, other, strict=True))
        return sine, cosine, rate

    def _angles(self, sine: Tensor, cosine: Tensor, which: Tensor) -> Tensor:
        """Return angles within half a turn of the middle of the joints' ranges; sine and cosine may have any norm."""
        middle = self.middle[which].to(sine.dtype)
        offset = middle - self.start[which].to(sine.dtype)
        turned = sine * offset.cos() - cosine * offset.sin(), cosine * offset.cos() + sine * offset.sin()
        return torch.atan2(*turned) + middle

    def forward(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return ``qpos`` ``[*B, nq]`` and ``qvel`` ``[*B, nv]``, float64, of states ``[*B, N, 13]``."""
        state = state.double()
        position, orientation, linear, angular = (state[..., where] for where in BODY_STATE.slices.values())
        matrices = quaternion.to_matrix(orientation).unflatten(-1, (3, 3))
        joints, positions, velocities = self.joints(state, matrices), [], []
        for name in self.groups:
            if name in ("ball", "free"):
                continue
            which = self._of(name)[1].flatten()
            positions.append(joints.coordinate[..., which])
            velocities.append(joints.rate[..., which])
        if "ball" in self.groups:
            ball = self._of("ball")[0]
            up = self.parent[ball]
            frame = quaternion.product(orientation[..., up, :], self.pose[ball, 3:].expand_as(orientation[..., up, :]))
            turn = quaternion.product(quaternion.conjugate(frame), orientation[..., ball, :])
            spin = turned_by(matrices.mT, angular - angular[..., self.parent, :])[..., ball, :]
            positions.append(turn.flatten(-2))
            velocities.append(spin.flatten(-2))
        if "free" in self.groups:
            free = self._of("free")[0]
            local = turned_by(matrices.mT, angular)[..., free, :]
            positions.append(torch.cat((position[..., free, :], orientation[..., free, :]), dim=-1).flatten(-2))
            velocities.append(torch.cat((linear[..., free, :], local), dim=-1).flatten(-2))
        qpos, qvel = (torch.cat(each, dim=-1) for each in (positions, velocities))
        return qpos[..., self.to_position], qvel[..., self.to_velocity]


def _branch(model: mujoco.MjModel, joints: list[int], middle: np.ndarray) -> float:
    """Return the sign that selects the half turn between gimbal locks with the middle of the second hinge's range."""
    return 1.0 if math.sin(middle[joints[1]] - gimbal_lock(model, joints)) >= 0 else -1.0


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.linalg.cross(*torch.broadcast_tensors(a, b))


def _twice_sine_axis(rotation: Tensor) -> Tensor:
    """Return twice the sine of the angle times the axis ``[..., 3]`` of rotation matrices."""
    minus = rotation - rotation.mT
    return torch.stack((minus[..., 2, 1], minus[..., 0, 2], minus[..., 1, 0]), dim=-1)


def _cosine(rotation: Tensor) -> Tensor:
    return 0.5 * (rotation[..., 0, 0] + rotation[..., 1, 1] + rotation[..., 2, 2] - 1)


def _angle_about(axis: Tensor, before: Tensor, after: Tensor) -> tuple[Tensor, Tensor]:
    """Return normalised sine and cosine of the angle about an axis that turns one vector into the other."""
    sine, cosine = _dot(axis, _cross(before, after)), _dot(before, after) - _dot(axis, before) * _dot(axis, after)
    length = (sine.square() + cosine.square() + _SHORT * _SHORT).sqrt()
    return sine / length, cosine / length


def _rotated(axis: Tensor, sine: Tensor, cosine: Tensor, vector: Tensor) -> Tensor:
    """Rotate a vector about an axis (Rodrigues' formula)."""
    along = _dot(axis, vector).unsqueeze(-1) * axis
    return along + cosine.unsqueeze(-1) * (vector - along) + sine.unsqueeze(-1) * _cross(axis, vector)


_Hinge = tuple[Tensor, Tensor, Tensor]  # sine and cosine of its angle, and its rate


def _columns(hinges: Sequence[_Hinge]) -> _Hinge:
    """Stack the hinges ``[*B, K]`` of bodies along a last dimension."""
    sine, cosine, rate = (torch.stack(each, dim=-1) for each in zip(*hinges, strict=True))
    return sine, cosine, rate


def _one_hinge(relative: Tensor, spin: Tensor, axis: Tensor) -> tuple[_Hinge]:
    """Return a hinge's angle and rate from a body's rotation ``[*B, K, 3, 3]`` and spin relative to its parent."""
    return ((0.5 * _dot(axis, _twice_sine_axis(relative)), _cosine(relative), _dot(axis, spin)),)


def _two_hinges(relative: Tensor, spin: Tensor, first: Tensor, second: Tensor) -> tuple[_Hinge, _Hinge]:
    """Return the angles and rates of two hinges.

    The body's rotation turns the second hinge's axis by the first hinge alone. The inverse rotation turns the first
    hinge's axis by the second hinge alone.
    """
    before = turned_by(relative.mT, first.expand(relative.shape[:-1]))
    one = _angle_about(first, second, turned_by(relative, second.expand(relative.shape[:-1])))
    sine, cosine = _angle_about(second, first, before)
    between = _dot(first, second)
    left, right = _dot(before, spin), _dot(second, spin)
    scale = 1 / (1 - between * between)
    return (*one, (left - between * right) * scale), (-sine, cosine, (right - between * left) * scale)


def _three_hinges(
    relative: Tensor, spin: Tensor, first: Tensor, second: Tensor, third: Tensor, branch: Tensor
) -> tuple[_Hinge, _Hinge, _Hinge]:
    """Return the angles and rates of three hinges (Davenport's angles).

    The angle between the axes of the outer two gives the middle one.
    """
    shape = relative.shape[:-1]
    after, before = turned_by(relative, third.expand(shape)), turned_by(relative.mT, first.expand(shape))
    # first . after = k + a cos + b sin of the middle angle.
    k = _dot(first, second) * _dot(second, third)
    a, b = _dot(first, third) - k, _dot(first, _cross(second, third))
    length = (a * a + b * b).sqrt()
    a, b, cosine_between = a / length, b / length, ((_dot(first, after) - k) / length).clamp(-1, 1)
    rest = branch.to(relative.dtype) * (1 - cosine_between * cosine_between).clamp(min=_TINY).sqrt()
    cosine, sine = a * cosine_between - b * rest, b * cosine_between + a * rest
    one = _angle_about(first, _rotated(second, sine, cosine, third.expand(shape)), after)
    backwards = _angle_about(third, _rotated(second, -sine, cosine, first.expand(shape)), before)
    middle = _rotated(third, *backwards, second.expand(shape))
    # spin = before rate_1 + middle rate_2 + third rate_3, regularised so that rates stay finite in gimbal lock.
    across = _cross(middle, third)
    volume = _dot(before, across)
    scale = volume / (volume * volume + _TINY)
    rates = [_dot(each, spin) * scale for each in (across, _cross(third, before), _cross(before, middle))]
    return (*one, rates[0]), (sine, cosine, rates[1]), (-backwards[0], backwards[1], rates[2])
