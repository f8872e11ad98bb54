"""Moments at joints due to wrenches on bodies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchrl_gn.dynamics.joint_coordinates import JointStates
from torchrl_gn.dynamics.lines import Lines
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.quaternion import turned_by
from torchrl_gn.scenes.force_elements import joint_groups
from torchrl_gn.scenes.lines import signs
from torchrl_gn.scenes.physical_parameters import joint_axes
from torchrl_gn.scenes.scene import Scene
from torchrl_gn.scenes.topology import topology

_HINGE, _SLIDE, _BALL, _FREE = (
    int(getattr(mujoco.mjtJoint, f"mjJNT_{name}")) for name in ("HINGE", "SLIDE", "BALL", "FREE")
)


class JointMoments(Float64Buffers):
    """Moments at ``joints`` ``[K]`` due to wrenches on the bodies that they carry, in the frame of the states.

    The moment at a hinge is the torque about its axis, at a slide the force along its axis.
    """

    node: Tensor
    axis: Tensor
    anchor_node: Tensor
    anchor: Tensor
    turns: Tensor
    slides: Tensor
    scalar: Tensor
    spins: Tensor
    pushes: Tensor
    third: Tensor
    third_axis: Tensor
    second_axis: Tensor
    middle: Tensor
    middle_node: Tensor
    to_middle: Tensor

    def __init__(self, scene: Scene, joints: Sequence[int]) -> None:
        super().__init__()
        model, chosen = scene.model, list(joints)
        kinds, (nodes, axes) = model.jnt_type[chosen], joint_axes(scene)
        child = scene.receivers[::2][chosen]
        # For the middle one of three hinges, the third hinge's rotation is undone from the body's frame.
        groups, _ = joint_groups(model, scene.body)
        last = {some[1]: some[2] for _, some in groups["three"]}
        middle = [index for index, joint in enumerate(chosen) if joint in last]
        self.any_middle = bool(middle)
        if middle:
            others = [last[chosen[index]] for index in middle]
            place = np.full(len(chosen), len(middle))
            place[middle] = np.arange(len(middle))
            values = {"third": np.array(others), "third_axis": model.jnt_axis[others], "middle": np.array(middle)}
            values |= {"second_axis": model.jnt_axis[[chosen[index] for index in middle]]}
            values |= {"middle_node": child[middle], "to_middle": place}
            self.constants(values)
        self.constants(
            {
                "node": nodes[chosen],
                "axis": axes[chosen],
                "anchor_node": child.copy(),
                "anchor": np.where((kinds == _FREE)[:, None], 0.0, model.jnt_pos[chosen]),
                "turns": (kinds != _SLIDE).astype(float)[:, None],
                "scalar": np.isin(kinds, (_HINGE, _SLIDE)),
                "slides": (kinds == _SLIDE).astype(float)[:, None],
                "spins": np.isin(kinds, (_BALL, _FREE)).astype(float)[:, None],
                "pushes": (kinds == _FREE).astype(float)[:, None],
            }
        )

    def forward(self, wrench: Tensor, state: Tensor, matrices: Tensor, joints: JointStates) -> tuple[Tensor, Tensor]:
        """Return moments ``[*B, K]`` and vectors ``[*B, K, 6]`` due to wrenches ``[*B, K, 6]`` about the origin.

        The vector is 0 for a hinge or slide. Balls and free joints have moment 1. The vector holds force and torque:
        for a ball only the torque, about its anchor; for a free joint both, about the body's origin.
        """
        dtype = state.dtype
        axis = turned_by(matrices[..., self.node, :, :], self.axis.to(dtype))
        if self.any_middle:
            sine, cosine = (each[..., self.third].unsqueeze(-1) for each in (joints.sine, joints.cosine))
            third, second = self.third_axis.to(dtype), self.second_axis.to(dtype)
            along = (third * second).sum(-1, keepdim=True) * third
            back = along + cosine * (second - along) - sine * torch.linalg.cross(third, second)
            turned = turned_by(matrices[..., self.middle_node, :, :], back)
            is_middle = (self.to_middle < len(self.middle)).unsqueeze(-1)
            axis = torch.where(is_middle, pad(turned, (0, 0, 0, 1))[..., self.to_middle, :], axis)
        anchor = state[..., self.anchor_node, :3] + turned_by(
            matrices[..., self.anchor_node, :, :], self.anchor.to(dtype)
        )
        force = wrench[..., :3]
        torque = wrench[..., 3:] - torch.linalg.cross(anchor, force)
        turns, slides, pushes, spins = (each.to(dtype) for each in (self.turns, self.slides, self.pushes, self.spins))
        moment = (axis * (turns * torque + slides * force)).sum(-1)
        return torch.where(self.scalar, moment, 1.0), torch.cat((pushes * force, spins * torque), dim=-1)


class LinePulls(NamedTuple):
    """Lengths and rates of lines, and their moments at joints."""

    length: Tensor  # [*B, L] metres
    velocity: Tensor  # [*B, L] rate of the length
    moment: Tensor  # [*B, K] per unit of tension, see JointMoments
    vector: Tensor  # [*B, K, 6] per unit of tension, see JointMoments


class LinesAtJoints(Float64Buffers):
    """Lines of a scene and their moments at joints; ``slots`` are ``[K]`` pairs of a line and a joint."""

    weight: Tensor

    def __init__(self, scene: Scene, lines: Lines, slots: Sequence[tuple[int, int]]) -> None:
        super().__init__()
        self.lines, self.any = lines, bool(slots)
        if slots:
            of_line, sides = lines.of_line.numpy(), signs(topology(scene.model), lines.ends.tolist())
            self.constants(
                {"weight": np.array([sides[joint] * (of_line == line) for line, joint in slots], dtype=float)}
            )
            self.moments = JointMoments(scene, [joint for _, joint in slots])

    def forward(self, state: Tensor, matrices: Tensor, joints: JointStates) -> LinePulls:
        pulls = self.lines(state, matrices)
        if not self.any:
            none = state.new_zeros((*state.shape[:-2], 0, 6))
            return LinePulls(pulls.length, pulls.velocity, none[..., 0], none)
        wrench = self.weight.to(state.dtype) @ pulls.wrench
        return LinePulls(pulls.length, pulls.velocity, *self.moments(wrench, state, matrices, joints))
