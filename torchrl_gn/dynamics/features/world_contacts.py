"""Gaps, normals and velocities at the nearest surfaces of the world as features of each body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_gn.dynamics.features.contacts import Contacts
from torchrl_gn.dynamics.features.feature import CLIPPED_SCALE, Feature, StepInputs
from torchrl_gn.maths import surface_distance
from torchrl_gn.maths.box_distance import segment_to_box
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.quaternion import turned_by
from torchrl_gn.maths.state_layout import BODY_STATE, StateLayout
from torchrl_gn.scenes import Articulation, Scene
from torchrl_gn.scenes.world_contacts import MOST_POINTS, shown_by_plane

if TYPE_CHECKING:
    from torchrl_gn.dynamics.features.canonical_state import BoundCanonicalizer
    from torchrl_gn.scenes.physical_parameters import PhysicalParameters

_NEAR = 0.02  # metres: gap at which the fine features are clipped
_FADE = 0.1  # metres: gap, now or a step later, from which on normal and velocity are 0
_FAR = 0.5  # metres: gap, now and a step later, from which on all features are 0
_NOWHERE = 1e3  # metres: gap to a surface that a point cannot touch
_TINY = 1e-9  # metres
_SIZE = 11


@dataclass(frozen=True)
class WorldContacts(Feature):
    """Gap, normal, velocity and friction of each body's points at the nearest surface that is fixed in the world.

    Like :class:`Contacts`, which has one plane and four points, but for eight points and for planes, boxes, cylinders,
    ellipsoids, hulls and height fields. Paper: the network sees positions and rotations alone.
    """

    part: ClassVar[Literal["nodes", "edges"]] = "nodes"

    @staticmethod
    def suits(scene: object) -> bool:
        """Return True if a scene has contacts with the world that :class:`Contacts` does not show."""
        return isinstance(scene, Scene) and not shown_by_plane(scene)

    def size(self, layout: StateLayout) -> int:
        return _SIZE * MOST_POINTS

    def least_scales(self, layout: StateLayout) -> list[float]:
        # A body that hardly ever meets the world in data may fall on it later.
        return [_NEAR, *[CLIPPED_SCALE] * (_SIZE - 1)] * MOST_POINTS

    def bind(self, scene: Articulation, layout: StateLayout, canonicalizer: BoundCanonicalizer) -> nn.Module:
        scene = self.require_bodies(scene)
        return _Bound(scene)


def contacts_of(scenes: Sequence[object]) -> Contacts | WorldContacts:
    """Choose the feature for the contacts of scenes with their worlds: :class:`Contacts` if it shows all of them."""
    return WorldContacts() if any(map(WorldContacts.suits, scenes)) else Contacts()


class _Bound(Float64Buffers):
    node: Tensor
    where: Tensor
    touches: Tensor
    own: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        contacts, surfaces = scene.world_contacts, scene.world_contacts.surfaces
        self.timestep, self.points = float(scene.timestep), len(contacts.node)
        self.spheres = int((~contacts.points[:, 13:].any(1)).sum())  # points before the segments
        # Point in each slot of each node; empty slots read the row of zeros that is appended to the points.
        where = np.full((scene.num_nodes, MOST_POINTS), self.points)
        where[contacts.node, contacts.slot] = np.arange(self.points)
        self.constants({"node": contacts.node, "where": where, "touches": contacts.touches, "own": contacts.velocity})
        self.moves = bool(contacts.constants[:, 16:].any())
        self.moves_itself = bool(contacts.velocity.any())
        # Surfaces of one kind are computed together, those with a shape of their own one by one.
        kinds: list[str] = contacts.kinds
        self.groups: list[tuple[str, int, int]] = []  # kind, first surface, last + 1
        for index, surface in enumerate(surfaces):
            together = index and surface.shape is None and kinds[index - 1] == kinds[index]
            start = self.groups.pop()[1] if together else index
            self.groups.append((kinds[index], start, index + 1))
        shapes = {f"shape_{index}": each.shape for index, each in enumerate(surfaces) if each.shape is not None}
        self.constants(shapes)

    def forward(self, inputs: StepInputs) -> Tensor:
        """Return features ``[*B, N, 88]``; 0 for missing points, and for those that stay 50 cm or more from surfaces.

        For each of eight points at its nearest surface:

        - 50 cm less the gap (metres);
        - the gaps now and a step later, mapped from 2 (2 cm inside or more) to 0 (2 cm outside or more);
        - fading out from 2 to 10 cm of the smaller of these gaps: the velocity away from the surface (m/s), the
          velocity along it (m/s), the normal and the friction coefficient.
        """
        state, matrices = inputs.canonical.state, inputs.canonical.matrices
        assert matrices is not None
        if not self.points:
            return state.new_zeros((*state.shape[:-1], _SIZE * MOST_POINTS))
        at, dtype = BODY_STATE.slices, state.dtype
        body, frame = state[..., self.node, :], matrices[..., self.node, :, :]
        world, origin = matrices[..., :1, :, :], state[..., :1, at["position"]]
        point = inputs.parameters.contact_point.to(dtype)
        arm = turned_by(frame, point[..., :3])
        contact_point = turned_by(world.mT, body[..., at["position"]] + arm - origin)
        axes = world.mT @ frame @ point[..., 4:13].unflatten(-1, (3, 3))
        segment = turned_by(world.mT, turned_by(frame, point[..., 13:]))
        gap, surface = self.nearest(contact_point, segment, point[..., 3:4], axes, inputs.parameters)
        normal, friction, from_place = surface[..., :3], surface[..., 3:4], surface[..., 4:7]
        normal, from_place = turned_by(world, normal), turned_by(world, from_place)
        arm = arm + from_place
        spin = body[..., at["angular_velocity"]]
        velocity = body[..., at["linear_velocity"]] + torch.linalg.cross(spin, arm)
        away = (velocity * normal).sum(-1, keepdim=True)
        if self.moves_itself:
            turns = turned_by(frame, self.own[:, 3:].to(dtype))
            velocity = velocity + turned_by(frame, self.own[:, :3].to(dtype)) + torch.linalg.cross(turns, from_place)
        if self.moves:
            velocity = velocity - turned_by(world, surface[..., 7:])
        along = velocity - (velocity * normal).sum(-1, keepdim=True) * normal
        gap = gap.unsqueeze(-1)
        soon = gap + self.timestep * away
        fine = [1 - (each / _NEAR).clamp(-1, 1) for each in (gap, soon)]
        share = ((_FADE - torch.minimum(gap, soon)) / (_FADE - _NEAR)).clamp(0, 1)
        features = torch.cat(
            ((_FAR - gap).clamp(min=0), *fine, share * torch.cat((away, along, normal, friction), dim=-1)), dim=-1
        )
        features = torch.cat((features, torch.zeros_like(features[..., :1, :])), dim=-2)
        return features[..., self.where, :].flatten(-2)

    def nearest(
        self, place: Tensor, segment: Tensor, radius: Tensor, axes: Tensor, parameters: PhysicalParameters
    ) -> tuple[Tensor, Tensor]:
        """Return the gap ``[*B, C]`` of each point to its nearest surface, and the contact ``[*B, C, 7 or 10]``.

        The contact is normal, friction, vector from the point's centre to where it touches and, if surfaces move, the
        surface's velocity there. Results and arguments ``[*B, C, ...]`` are in the world's frame.
        """
        surface, pair = (each.to(place.dtype) for each in (parameters.surface, parameters.contact_pair))
        surface = surface.unsqueeze(-3)  # [*B, 1, S, 22]
        turns = surface[..., 3:12].unflatten(-1, (3, 3))
        local = turned_by(turns.mT, place.unsqueeze(-2) - surface[..., :3])  # [*B, C, S, 3]
        distances = []
        for kind, first, end in self.groups:
            here, half = local[..., first:end, :], surface[..., first:end, 12:15]
            shift = torch.zeros_like(here)
            if kind == "box" and self.spheres < self.points:
                shift = self._along(here, turned_by(turns[..., first:end, :, :].mT, segment.unsqueeze(-2)), half)
            distances.append((*self._distance(kind, first, here + shift, half), shift))
        distance, normal, shift = (
            torch.cat(parts, dim) for parts, dim in zip(zip(*distances, strict=True), (-1, -2, -2), strict=True)
        )
        distance, normal, shift = distance - surface[..., 15], turned_by(turns, normal), turned_by(turns, shift)
        # Extent of an ellipsoid towards the surface, and its deepest point.
        reach = (normal.unsqueeze(-2) @ axes.unsqueeze(-3)).squeeze(-2)  # [*B, C, S, 3]
        length = (reach.square().sum(-1, keepdim=True) + _TINY**2).sqrt()
        deepest = turned_by(axes.unsqueeze(-3), reach / length)
        gap = distance - radius - (length.squeeze(-1) - _TINY) - pair[..., 1]
        gap = torch.where(self.touches, gap, _NOWHERE)
        shift = shift - deepest - radius.unsqueeze(-1) * normal
        parts = [gap.unsqueeze(-1), normal, pair[..., :1].expand_as(length), shift]
        if self.moves:
            linear, angular = (turned_by(turns, each) for each in (surface[..., 16:19], surface[..., 19:22]))
            touched = place.unsqueeze(-2) + shift - surface[..., :3]
            parts.append(linear + torch.linalg.cross(angular.expand_as(touched), touched))
        candidates = torch.cat(parts, dim=-1).unbind(-2)
        best = candidates[0]
        for candidate in candidates[1:]:
            best = torch.where(candidate[..., :1] < best[..., :1], candidate, best)
        return best[..., 0], best[..., 1:]

    def _along(self, local: Tensor, segment: Tensor, half: Tensor) -> Tensor:
        """Return vectors from segments' first ends ``[*B, C, G, 3]`` to their points nearest to boxes.

        All are in the boxes' frames.
        """
        count = self.points - self.spheres
        none, begin = local.split((self.spheres, count), dim=-3)
        line = segment[..., self.spheres :, :, :].expand_as(begin)
        fraction = segment_to_box(begin, line, half.expand_as(begin)).fraction
        return torch.cat((torch.zeros_like(none), fraction.unsqueeze(-1) * line), dim=-3)

    def _distance(self, kind: str, first: int, point: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
        """Return distances ``[*B, C, G]`` and normals of points ``[*B, C, G, 3]``, in the frames of ``G`` surfaces."""
        if kind == "plane":
            return surface_distance.from_plane(point)
        if kind == "box":
            return surface_distance.from_box(point, half)
        if kind == "cylinder":
            return surface_distance.from_cylinder(point, half[..., 0], half[..., 1])
        if kind == "ellipsoid":
            return surface_distance.from_ellipsoid(point, half)
        shape = self.get_buffer(f"shape_{first}").to(point.dtype)
        if kind == "hull":
            return surface_distance.from_hull(point, shape)
        return surface_distance.from_heights(point, shape, half[..., :2], _NOWHERE)
