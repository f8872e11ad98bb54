"""Joint coordinates of a scene's body states."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_gn.maths import quaternion
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.scenes.scene import Scene, UnsupportedSceneError

_KINDS = mujoco.mjtJoint


class JointCoordinates(Float64Buffers):
    """MuJoCo's ``qpos`` and ``qvel`` of body states, differentiable.

    For bodies with a free joint, or with slides and then at most one hinge; a hinge's angle is the one nearest to the
    middle of its range. Of states that the joints do not allow, it takes the nearest.

    Raises:
        UnsupportedSceneError: names the joint whose coordinate does not follow.
    """

    parent: Tensor
    position: Tensor
    orientation: Tensor
    anchor: Tensor
    slide_node: Tensor
    slide_row: Tensor
    slide_start: Tensor
    hinge_node: Tensor
    hinge_axis: Tensor
    hinge_start: Tensor
    hinge_middle: Tensor
    free_node: Tensor
    to_position: Tensor
    to_velocity: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        model, count = scene.model, scene.num_nodes
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        anchors = np.zeros((count, 3))
        slides, hinges, free = [], [], []
        for node, body in enumerate(scene.body.tolist()):
            if not node:
                continue
            joints = range(int(model.body_jntadr[body]), int(model.body_jntadr[body] + model.body_jntnum[body]))
            kinds = [int(model.jnt_type[joint]) for joint in joints]
            if kinds == [_KINDS.mjJNT_FREE]:
                free.append((node, joints[0]))
                continue
            axes = np.stack([model.jnt_axis[joint] for joint in joints], axis=1)
            hinged = kinds[-1] == _KINDS.mjJNT_HINGE
            slid = len(kinds) - hinged
            if any(kind != _KINDS.mjJNT_SLIDE for kind in kinds[:slid]) or (
                slid and np.linalg.matrix_rank(axes[:, :slid]) < slid  # NumPy 1 takes no empty matrix
            ):
                names = [scene.joint_names[joint] for joint in joints]
                raise UnsupportedSceneError(
                    f"The coordinates of joints {names} of scene {scene.name!r} do not follow from body states here: a"
                    " body may have a free joint, or independent slides followed by at most one hinge."
                )
            slides += [(node, *each) for each in zip(joints, np.linalg.pinv(axes[:, :slid]), strict=False)]
            if hinged:
                anchors[node] = model.jnt_pos[joints[-1]]
                hinges.append((node, joints[-1]))
        # At the reference pose no joint has moved: bodies are where their joints start from.
        upper = np.maximum(scene.parent, 0)
        place, turn = (torch.from_numpy(of[scene.body].copy()) for of in (data.xpos, data.xquat))
        back = quaternion.conjugate(turn[upper])
        hinge_joints, slide_joints = [joint for _, joint in hinges], [joint for _, joint, _ in slides]
        start = model.qpos0[model.jnt_qposadr[hinge_joints]] if hinges else np.zeros(0)
        limited = model.jnt_limited[hinge_joints].astype(bool)
        joints = [*slide_joints, *hinge_joints]
        free_joints = [joint for _, joint in free]
        to_position = [int(model.jnt_qposadr[joint]) for joint in joints]
        to_velocity = [int(model.jnt_dofadr[joint]) for joint in joints]
        to_position += [int(model.jnt_qposadr[joint]) + index for joint in free_joints for index in range(7)]
        to_velocity += [int(model.jnt_dofadr[joint]) + index for joint in free_joints for index in range(6)]
        self.constants(
            {
                "parent": upper,
                "position": quaternion.rotate(back, place - place[upper]),
                "orientation": quaternion.product(back, turn),
                "anchor": anchors,
                "slide_node": torch.tensor([node for node, *_ in slides], dtype=torch.long),
                "slide_row": np.array([row for *_, row in slides]).reshape(-1, 3),
                "slide_start": model.qpos0[model.jnt_qposadr[slide_joints]] if slides else np.zeros(0),
                "hinge_node": torch.tensor([node for node, _ in hinges], dtype=torch.long),
                "hinge_axis": model.jnt_axis[hinge_joints].reshape(-1, 3),
                "hinge_start": start,
                "hinge_middle": np.where(limited, model.jnt_range[hinge_joints].mean(1), start),
                "free_node": torch.tensor([node for node, _ in free], dtype=torch.long),
                "to_position": np.argsort(to_position),
                "to_velocity": np.argsort(to_velocity),
            }
        )

    def forward(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """``qpos`` ``[*B, nq]`` and ``qvel`` ``[*B, nv]``, float64, of states ``[*B, N, 13]``."""
        state = state.double()
        position, orientation, linear, angular = (state[..., where] for where in BODY_STATE.slices.values())
        above = [each[..., self.parent, :] for each in (position, orientation, linear, angular)]
        from_frame = quaternion.product(above[1], self.orientation.expand_as(orientation))
        relative = quaternion.product(quaternion.conjugate(from_frame), orientation)
        turning = angular - above[3]

        # Slides: what is left of a body's place when the parent's frame and the hinge are accounted for.
        to_frame = quaternion.conjugate(from_frame)
        arm = quaternion.rotate(orientation, self.anchor.expand_as(position))
        moved = position - above[0] - quaternion.rotate(above[1], self.position.expand_as(position))
        place = quaternion.rotate(to_frame, moved + arm) - self.anchor
        rate = linear - above[2] - torch.linalg.cross(above[3], position - above[0]) + torch.linalg.cross(turning, arm)
        rate = quaternion.rotate(to_frame, rate)
        slides = (place[..., self.slide_node, :] * self.slide_row).sum(-1) + self.slide_start
        slide_rates = (rate[..., self.slide_node, :] * self.slide_row).sum(-1)

        rotation = relative[..., self.hinge_node, :]
        angle = 2 * torch.atan2((rotation[..., 1:] * self.hinge_axis).sum(-1), rotation[..., 0]) + self.hinge_start
        turns = ((angle - self.hinge_middle) / (2 * math.pi)).detach().round()
        own = quaternion.rotate(quaternion.conjugate(orientation), turning)[..., self.hinge_node, :]
        hinge_rates = (own * self.hinge_axis).sum(-1)

        free, local = self.free_node, quaternion.rotate(quaternion.conjugate(orientation), angular)
        pose = torch.cat((position[..., free, :], orientation[..., free, :]), dim=-1).flatten(-2)
        twist = torch.cat((linear[..., free, :], local[..., free, :]), dim=-1).flatten(-2)
        found = torch.cat((slides, angle - 2 * math.pi * turns, pose), dim=-1)
        rates = torch.cat((slide_rates, hinge_rates, twist), dim=-1)
        return found[..., self.to_position], rates[..., self.to_velocity]
