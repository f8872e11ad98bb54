"""What a body is about to touch, as features of its node."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.modules import quaternion
from torchrl_gn.modules.float64_buffers import Float64Buffers
from torchrl_gn.modules.state_layout import BODY_STATE
from torchrl_gn.scenes.contact_points import SLOTS, contact_slots

if TYPE_CHECKING:
    from torchrl_gn.scenes import Scene

_NEAR = 0.02  # metres: within this of the plane distances are shown finely


class Contacts(Float64Buffers):
    """Distances and velocities of the points that can touch the scene's plane.

    A contact force sets in within millimetres of a body that moves metres. To find that from
    positions and rotations a network has to compute distances to a thousandth; here they are
    computed for it. Paper: the network sees positions and rotations alone.

    Args:
        scene: whose points these are (:attr:`Scene.contact_points <torchrl_gn.scenes.Scene>`).
    """

    size = 6 * SLOTS

    mask: Tensor
    normal: Tensor
    origin: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        self.timestep = float(scene.timestep)
        points = scene.contact_points
        _, _, mask = contact_slots(scene)
        values = {
            "mask": mask,
            "normal": np.array([0.0, 0.0, 1.0]) if points is None else points.normal,
            "origin": np.zeros(3) if points is None else points.origin,
        }
        self.constants(values)

    def forward(self, state: Tensor, offset: Tensor, radius: Tensor) -> Tensor:
        """Features of every node.

        Args:
            state: ``[*B, N, 13]``, the world first: the plane is fixed to it.
            offset: ``[N, 4, 3]`` or ``[*B, N, 4, 3]`` points in the nodes' frames, metres.
            radius: ``[N, 4]`` or ``[*B, N, 4]``.

        Returns:
            ``[*B, N, 24]``: for every point its distance from the plane, the same finely where it is
            small, where it will be a control step on, and its velocity; 0 where there is no point.
        """
        at = BODY_STATE.slices
        position, velocity = state[..., at["position"]], state[..., at["linear_velocity"]]
        world = state[..., :1, at["orientation"]]
        normal = quaternion.rotate(world, self.normal.to(state.dtype)).unsqueeze(-2)  # [*B, 1, 1, 3]
        origin = quaternion.rotate(world, self.origin.to(state.dtype)) + position[..., :1, :]
        frame = quaternion.to_matrix(state[..., at["orientation"]]).unflatten(-1, (3, 3))
        arm = offset.to(state.dtype) @ frame.mT  # [*B, N, 4, 3]
        spin = state[..., at["angular_velocity"]].unsqueeze(-2).expand_as(arm)
        moving = velocity.unsqueeze(-2) + torch.linalg.cross(spin, arm)
        away = ((position - origin).unsqueeze(-2) + arm) * normal
        distance = away.sum(-1) - radius.to(state.dtype)
        soon = distance + self.timestep * (moving * normal).sum(-1)
        fine = [(value / _NEAR).clamp(-1, 1) for value in (distance, soon)]
        features = torch.cat((torch.stack((distance, *fine), dim=-1), moving), dim=-1)
        return (features * self.mask.unsqueeze(-1)).flatten(-2)
