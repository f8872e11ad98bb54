"""Distances from a plane fixed in the world as features of each body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_gn.dynamics.features.feature import Feature, StepInputs
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.state_layout import BODY_STATE, StateLayout
from torchrl_gn.scenes.contact_points import SLOTS, contact_slots

if TYPE_CHECKING:
    from torchrl_gn.dynamics.features.canonical_state import BoundCanonicalizer
    from torchrl_gn.scenes import Articulation, Scene

_NEAR = 0.02  # metres: distance from the plane at which the fine features are clipped


@dataclass(frozen=True)
class Contacts(Feature):
    """Distances and velocities of the points that can touch the scene's plane.

    Contact forces set in within millimetres, while bodies move metres. Given the distance, the network need not compute
    it from positions.
    Paper: the network sees positions and rotations alone.
    """

    part: ClassVar[Literal["nodes", "edges"]] = "nodes"

    def size(self, layout: StateLayout) -> int:
        return 6 * SLOTS

    def bind(self, scene: Articulation, layout: StateLayout, canonicalizer: BoundCanonicalizer) -> nn.Module:
        scene = self.require_bodies(scene)
        return BoundContacts(scene)


class BoundContacts(Float64Buffers):
    """Contact features of one scene."""

    mask: Tensor
    normal: Tensor
    origin: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        self.timestep = float(scene.timestep)
        points = scene.contact_points
        self.any = points is not None
        _, _, mask = contact_slots(scene)
        normal, origin = ([0.0, 0.0, 1.0], np.zeros(3)) if points is None else (points.normal, points.origin)
        self.constants({"mask": mask, "normal": np.asarray(normal), "origin": origin})

    def forward(self, inputs: StepInputs) -> Tensor:
        """Return features ``[*B, N, 24]``; 0 for missing points.

        For each of four points: its distance from the plane (metres); the distances now and a step later, clipped to
        2 cm and scaled to 1; and its velocity (m/s).
        """
        state, matrices = inputs.canonical[:2]
        if not self.any:
            return state.new_zeros((*state.shape[:-1], 6 * SLOTS))
        assert matrices is not None
        offset, radius = inputs.parameters.contact_offset, inputs.parameters.contact_radius
        at = BODY_STATE.slices
        position, velocity = state[..., at["position"]], state[..., at["linear_velocity"]]
        plane = torch.stack((self.normal, self.origin)).to(state.dtype) @ matrices[..., :1, :, :].mT  # [*B, 1, 2, 3]
        normal, origin = plane[..., :1, :], plane[..., 1, :] + position[..., :1, :]
        point = offset.to(state.dtype) @ matrices.mT  # [*B, N, 4, 3]
        spin = state[..., at["angular_velocity"]].unsqueeze(-2).expand_as(point)
        moving = velocity.unsqueeze(-2) + torch.linalg.cross(spin, point)
        away = ((position - origin).unsqueeze(-2) + point) * normal
        distance = away.sum(-1) - radius.to(state.dtype)
        soon = distance + self.timestep * (moving * normal).sum(-1)
        fine = [(value / _NEAR).clamp(-1, 1) for value in (distance, soon)]
        features = torch.cat((torch.stack((distance, *fine), dim=-1), moving), dim=-1)
        return (features * self.mask.unsqueeze(-1)).flatten(-2)
