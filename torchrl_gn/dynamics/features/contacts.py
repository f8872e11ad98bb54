"""What a body is about to touch, as features of its node."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.state_layout import BODY_STATE
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
        self.any = points is not None
        _, _, mask = contact_slots(scene)
        values = {
            "mask": mask,
            "normal": np.array([0.0, 0.0, 1.0]) if points is None else points.normal,
            "origin": np.zeros(3) if points is None else points.origin,
        }
        self.constants(values)

    def forward(self, state: Tensor, matrices: Tensor, offset: Tensor, radius: Tensor) -> Tensor:
        """Features of every node.

        Args:
            state: ``[*B, N, 13]``, the world first: the plane is fixed to it.
            matrices: ``[*B, N, 3, 3]`` of the orientations in it.
            offset: ``[N, 4, 3]`` or ``[*B, N, 4, 3]`` points in the nodes' frames, metres.
            radius: ``[N, 4]`` or ``[*B, N, 4]``.

        Returns:
            ``[*B, N, 24]``: for every point its distance from the plane, the same finely where it is
            small, where it will be a control step on, and its velocity; 0 where there is no point.
        """
        if not self.any:
            return state.new_zeros((*state.shape[:-1], self.size))
        at = BODY_STATE.slices
        position, velocity = state[..., at["position"]], state[..., at["linear_velocity"]]
        plane = torch.stack((self.normal, self.origin)).to(state.dtype) @ matrices[..., :1, :, :].mT  # [*B, 1, 2, 3]
        normal, origin = plane[..., :1, :], plane[..., 1, :] + position[..., :1, :]
        arm = offset.to(state.dtype) @ matrices.mT  # [*B, N, 4, 3]
        spin = state[..., at["angular_velocity"]].unsqueeze(-2).expand_as(arm)
        moving = velocity.unsqueeze(-2) + torch.linalg.cross(spin, arm)
        away = ((position - origin).unsqueeze(-2) + arm) * normal
        distance = away.sum(-1) - radius.to(state.dtype)
        soon = distance + self.timestep * (moving * normal).sum(-1)
        fine = [(value / _NEAR).clamp(-1, 1) for value in (distance, soon)]
        features = torch.cat((torch.stack((distance, *fine), dim=-1), moving), dim=-1)
        return (features * self.mask.unsqueeze(-1)).flatten(-2)
