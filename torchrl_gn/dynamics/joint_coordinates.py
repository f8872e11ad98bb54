"""Joint coordinates of a scene's body states."""

from __future__ import annotations

import math
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
from torchrl_gn.scenes.force_elements import JOINT_GROUPS, joint_constants, joint_groups, joint_poses
from torchrl_gn.scenes.scene import Scene, UnsupportedSceneError

_HINGE, _SLIDE, _BALL, _FREE = (
    int(getattr(mujoco.mjtJoint, f"mjJNT_{name}")) for name in ("HINGE", "SLIDE", "BALL", "FREE")
)
_LENGTHS = {_HINGE: (1, 1), _SLIDE: (1, 1), _BALL: (4, 3), _FREE: (7, 6)}  # of a joint in qpos and qvel
_TINY = 1e-12  # keeps square roots and quotients differentiable where three hinges lock
_REST = 1e-10  # the same where a ball is at rest: a squared sine


class JointStates(NamedTuple):
    """Coordinates of all joints of a scene, 0 where they do not follow from body states."""

    sine: Tensor  # [*B, J] of the angle of a hinge or ball from the reference pose; 0 of a slide
    cosine: Tensor  # [*B, J]
    coordinate: Tensor  # [*B, J] MuJoCo's of a hinge or slide, the angle of a ball; rad or m
    rate: Tensor  # [*B, J] of the coordinate, rad/s or m/s


class JointCoordinates(Float64Buffers):
    """Coordinates and rates of joints from body states, differentiable.

    Of bodies whose joints :func:`~torchrl_gn.scenes.force_elements.joint_groups` knows. A hinge's angle is the one
    nearest to that in the state, if it holds one (``Scene.unwrapped``), else to the middle of its range; the middle one
    of three hinges is taken for within 90 degrees of its own. Of states that joints do not allow, it takes one near.

    Args:
        scene: the scene.
        partly: leave joints of other bodies out (:attr:`known`) instead of refusing the scene.

    Raises:
        UnsupportedSceneError: names the joints whose coordinates do not follow.
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
        # Behind the joints found stands a 0 for all others.
        to_joints = np.full(model.njnt, scalars)
        to_joints[order[:scalars]] = np.arange(scalars)
        places = [
            [int(address[joint]) + i for joint in order for i in range(_LENGTHS[int(model.jnt_type[joint])][of])]
            for of, address in enumerate((model.jnt_qposadr, model.jnt_dofadr))
        ]
        start = model.qpos0[model.jnt_qposadr] * np.isin(model.jnt_type, (_HINGE, _SLIDE))
        middle = np.where(model.jnt_limited.astype(bool), model.jnt_range.mean(1), start)
        self.groups = tuple(name for name, found in groups.items() if found)  # torch.export saves no empty tensors
        for name in self.groups:
            found = groups[name]
            at = torch.tensor([node for node, _ in found], dtype=torch.long)
            of = torch.tensor([some for _, some in found], dtype=torch.long).reshape(len(found), JOINT_GROUPS[name])
            self.constants({f"{name}_node": at, f"{name}_joints": of})
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
        if not self.any_winds:  # torch.export saves no empty tensors
            return
        angle = np.full(model.njnt, count)
        angle[unwrapped.joint] = np.arange(count)
        channel = scene.state_size - unwrapped.size + unwrapped.slot
        self.constants({"winds": angle < count, "angle": angle, "node": unwrapped.node, "channel": channel})

    def _of(self, name: str) -> tuple[Tensor, Tensor]:
        """Nodes ``[K]`` of a group and their joints ``[K, n]``."""
        return getattr(self, f"{name}_node"), getattr(self, f"{name}_joints")

    def joints(
        self, state: Tensor, matrices: Tensor, pose: Tensor | None = None, joint: Tensor | None = None
    ) -> JointStates:
        """Joints of states ``[*B, N, 13]`` with the matrices ``[*B, N, 3, 3]`` of their orientations.

        ``pose`` and ``joint`` ``[*B, J, 8]`` are those of :class:`PhysicalParameters`; default: the scene's.
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
            place = turned_by(to_frame, moved + arm) - anchor
            # The parent's frame carries the body along, the body's own turn its anchor.
            carried = torch.linalg.cross(angular[..., up, :], position[..., at, :] - position[..., up, :])
            rate = linear[..., at, :] - linear[..., up, :] - carried
            rate = turned_by(to_frame, rate + torch.linalg.cross(turning[..., at, :], arm))
            coordinate = (place * axis).sum(-1) + self.start[which[:, 0]].to(state.dtype)
            parts.append(
                (torch.zeros_like(coordinate), torch.zeros_like(coordinate), coordinate, (rate * axis).sum(-1))
            )

        for name, hinges in (("one", _one_hinge), ("two", _two_hinges), ("three", _three_hinges)):
            if name in self.groups:
                at, which = self._of(name)
                axes = [joint[..., each, :3] for each in which.unbind(-1)]
                more = (self.branch,) if name == "three" else ()
                found = hinges(relative[..., at, :, :], spin[..., at, :], *axes, *more)
                sine, cosine, rate = (torch.stack(each, dim=-1) for each in zip(*found, strict=True))  # [*B, K, n]
                sine, cosine, rate = (each.flatten(-2) for each in (sine, cosine, rate))
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
        """Joints with the angles nearest to those that the state holds."""
        held = pad(state[..., self.node, self.channel], (0, 1))[..., self.angle]
        away = found.coordinate - held
        nearest = held + torch.atan2(away.sin(), away.cos())
        return found._replace(coordinate=torch.where(self.winds, nearest, found.coordinate))

    def _angles(self, sine: Tensor, cosine: Tensor, which: Tensor) -> Tensor:
        """Angles within half a turn of the middle of the joints' ranges; sine and cosine may have any length."""
        middle = self.middle[which].to(sine.dtype)
        offset = middle - self.start[which].to(sine.dtype)
        turned = sine * offset.cos() - cosine * offset.sin(), cosine * offset.cos() + sine * offset.sin()
        return torch.atan2(*turned) + middle

    def forward(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """``qpos`` ``[*B, nq]`` and ``qvel`` ``[*B, nv]``, float64, of states ``[*B, N, 13]``."""
        state = state.double()
        position, orientation, linear, angular = (state[..., where] for where in BODY_STATE.slices.values())
        matrices = quaternion.to_matrix(orientation).unflatten(-1, (3, 3))
        found, positions, velocities = self.joints(state, matrices), [], []
        for name in self.groups:
            if name in ("ball", "free"):
                continue
            which = self._of(name)[1].flatten()
            positions.append(found.coordinate[..., which])
            velocities.append(found.rate[..., which])
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
    """Which of its two angles the middle one of three hinges takes: the sign of the one nearer to its range."""
    first, second, third = model.jnt_axis[joints]
    zero = math.atan2(first @ np.cross(second, third), first @ third - (first @ second) * (second @ third))
    return 1.0 if math.sin(middle[joints[1]] - zero) >= 0 else -1.0


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.linalg.cross(*torch.broadcast_tensors(a, b))


def _twice_sine_axis(rotation: Tensor) -> Tensor:
    """Twice the sine times the axis ``[..., 3]`` of rotation matrices."""
    minus = rotation - rotation.mT
    return torch.stack((minus[..., 2, 1], minus[..., 0, 2], minus[..., 1, 0]), dim=-1)


def _cosine(rotation: Tensor) -> Tensor:
    return 0.5 * (rotation[..., 0, 0] + rotation[..., 1, 1] + rotation[..., 2, 2] - 1)


def _about(axis: Tensor, before: Tensor, after: Tensor) -> tuple[Tensor, Tensor]:
    """Sine and cosine, of unit length, of the angle about an axis that turns one vector into the other."""
    sine, cosine = _dot(axis, _cross(before, after)), _dot(before, after) - _dot(axis, before) * _dot(axis, after)
    length = (sine.square() + cosine.square() + _TINY).sqrt()
    return sine / length, cosine / length


def _rotated(axis: Tensor, sine: Tensor, cosine: Tensor, vector: Tensor) -> Tensor:
    """A vector turned about an axis (Rodrigues' formula)."""
    along = _dot(axis, vector).unsqueeze(-1) * axis
    return along + cosine.unsqueeze(-1) * (vector - along) + sine.unsqueeze(-1) * _cross(axis, vector)


_Hinge = tuple[Tensor, Tensor, Tensor]  # sine and cosine of its angle, and its rate


def _one_hinge(relative: Tensor, spin: Tensor, axis: Tensor) -> tuple[_Hinge]:
    """A hinge's angle and rate of a body's rotation ``[*B, K, 3, 3]`` and angular velocity against its parent."""
    return ((0.5 * _dot(axis, _twice_sine_axis(relative)), _cosine(relative), _dot(axis, spin)),)


def _two_hinges(relative: Tensor, spin: Tensor, first: Tensor, second: Tensor) -> tuple[_Hinge, _Hinge]:
    """Those of two hinges: what the first does to the second's axis, and the inverse of the second to the first's."""
    before = turned_by(relative.mT, first.expand(relative.shape[:-1]))
    one = _about(first, second, turned_by(relative, second.expand(relative.shape[:-1])))
    sine, cosine = _about(second, first, before)
    between = _dot(first, second)
    left, right = _dot(before, spin), _dot(second, spin)
    scale = 1 / (1 - between * between)
    return (*one, (left - between * right) * scale), (-sine, cosine, (right - between * left) * scale)


def _three_hinges(
    relative: Tensor, spin: Tensor, first: Tensor, second: Tensor, third: Tensor, branch: Tensor
) -> tuple[_Hinge, _Hinge, _Hinge]:
    """Those of three hinges (Davenport's angles): the middle one is the angle between the outer two's axes."""
    shape = relative.shape[:-1]
    after, before = turned_by(relative, third.expand(shape)), turned_by(relative.mT, first.expand(shape))
    # first . after = k + a cos + b sin of the middle angle.
    k = _dot(first, second) * _dot(second, third)
    a, b = _dot(first, third) - k, _dot(first, _cross(second, third))
    length = (a * a + b * b).sqrt()
    a, b, apart = a / length, b / length, ((_dot(first, after) - k) / length).clamp(-1, 1)
    rest = branch.to(relative.dtype) * (1 - apart * apart).clamp(min=_TINY).sqrt()
    cosine, sine = a * apart - b * rest, b * apart + a * rest
    one = _about(first, _rotated(second, sine, cosine, third.expand(shape)), after)
    backwards = _about(third, _rotated(second, -sine, cosine, first.expand(shape)), before)
    middle = _rotated(third, *backwards, second.expand(shape))
    # spin = before rate_1 + middle rate_2 + third rate_3; where they lock, no rate is infinite.
    across = _cross(middle, third)
    volume = _dot(before, across)
    scale = volume / (volume * volume + _TINY)
    rates = [_dot(each, spin) * scale for each in (across, _cross(third, before), _cross(before, middle))]
    return (*one, rates[0]), (sine, cosine, rates[1]), (-backwards[0], backwards[1], rates[2])
