"""Distances and velocities between bodies that can touch, as features of edges between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchrl_gn.dynamics.features.feature import CLIPPED_SCALE, Feature, StepInputs
from torchrl_gn.maths.box_distance import segment_to_box
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.quaternion import turned_by
from torchrl_gn.maths.state_layout import BODY_STATE, StateLayout
from torchrl_gn.scenes import Articulation, Scene

if TYPE_CHECKING:
    from torchrl_gn.dynamics.features.canonical_state import BoundCanonicalizer
    from torchrl_gn.scenes.contact_pairs import ContactPairs

_NEAR = 0.02  # metres: distance at which the fine features are clipped
_FAR = 0.1  # metres: distance, now and a step later, from which on all features are 0
_SAME = 0.005  # metres: places closer to each other than this count as one
_TIE = 1e-5  # metres: if distances differ by less, the first place is taken, so that rounding does not decide
_NOWHERE = 1e3  # metres: distance of a place without candidate
_SIZE = 13
_CANDIDATE = (
    *("segment_node", "box_node", "start", "direction", "center", "rotation", "half_size", "radius", "has_ends"),
)


@dataclass(frozen=True)
class PairContacts(Feature):
    """Distances, velocities and normals at the nearest places of bodies that can touch.

    A default feature of scenes in which bodies of different trees can touch (:func:`trees_can_touch`), such as a finger
    and an object.

    Adds a pair of edges between any two such bodies (:attr:`Scene.contact_pairs`). The features are 0 on all other
    edges. Paper: bodies interact through joints alone.
    """

    part: ClassVar[Literal["nodes", "edges"]] = "edges"
    adds_edges: ClassVar[bool] = True

    places: int = 2  # number of nearest places of each pair

    def __post_init__(self) -> None:
        if self.places < 1:
            raise ValueError(f"places={self.places} must be positive.")

    def size(self, layout: StateLayout) -> int:
        return _SIZE * self.places

    def least_scales(self, layout: StateLayout) -> list[float]:
        # Two bodies that hardly ever touch in data may touch later.
        return [_NEAR, *[CLIPPED_SCALE] * (_SIZE - 4), *[_NEAR] * 3] * self.places

    def added_edges(self, scene: Articulation) -> np.ndarray:
        nodes = _pairs(self.require_bodies(scene)).nodes
        return np.stack((nodes, nodes[:, ::-1]), axis=1).reshape(-1, 2).T

    def bind(self, scene: Articulation, layout: StateLayout, canonicalizer: BoundCanonicalizer) -> nn.Module:
        return BoundPairContacts(self.require_bodies(scene), self.places)


def trees_can_touch(scene: object) -> bool:
    """Return True if bodies of different kinematic trees can touch: no joint couples these, only contacts do."""
    if not isinstance(scene, Scene) or scene.model.ntree < 2:
        return False
    first, second = scene.model.body_treeid[scene.body[scene.contact_pairs.nodes]].T  # -1: the world's
    return bool(((first != second) & (first >= 0) & (second >= 0)).any())


def _pairs(scene: Scene) -> ContactPairs:
    if scene.contact_pairs is None:
        raise ValueError(
            f"PairContacts needs states of bodies; scene {scene.name!r} has others: leave the feature out."
        )
    return scene.contact_pairs


class BoundPairContacts(Float64Buffers):
    """Pair contacts of one scene."""

    first: Tensor
    second: Tensor
    segment_node: Tensor
    box_node: Tensor
    start: Tensor
    direction: Tensor
    center: Tensor
    rotation: Tensor
    half_size: Tensor
    radius: Tensor
    has_ends: Tensor
    sign: Tensor
    tie: Tensor

    def __init__(self, scene: Scene, places: int) -> None:
        super().__init__()
        pairs = _pairs(scene)
        self.timestep, self.places, self.joint_edges = float(scene.timestep), places, scene.num_edges
        # Candidates in rounds: the first of each pair, then the second of those that have one, ...
        number = np.arange(len(pairs.pair)) - np.searchsorted(pairs.pair, pairs.pair)
        order, self.rounds = np.lexsort((pairs.pair, number)), np.bincount(number).tolist()
        # On ties between a segment and its ends, prefer the ends.
        tie = _TIE * (number + len(self.rounds) * pairs.has_ends)
        # Normals point from a pair's first node to its second.
        sign = np.where(pairs.segment_node == pairs.nodes[pairs.pair, 1], 1.0, -1.0)
        values = {name: getattr(pairs, name) for name in _CANDIDATE} | {"tie": tie, "sign": sign}
        first, second = pairs.nodes.T.copy()
        self.constants({"first": first, "second": second, **{name: value[order] for name, value in values.items()}})

    def forward(self, inputs: StepInputs) -> Tensor:
        """Return features ``[*B, E, 13 K]`` of all edges; 0 at joints, and for bodies that stay 10 cm apart or more.

        For each of ``K`` places:

        - 10 cm less the distance (metres);
        - the distances now and a step later, mapped from 2 (2 cm inside or more) to 0 (2 cm apart or more);
        - fading out from 2 to 10 cm: the velocity of separation (m/s), the receiver's relative velocity along the
          surface (m/s), the normal towards the receiver, and the place relative to the receiver's origin (metres).
        """
        state, matrices = inputs.canonical.state, inputs.canonical.matrices
        if not self.rounds:
            return state.new_zeros((*state.shape[:-2], self.joint_edges, _SIZE * self.places))
        assert matrices is not None
        places = self.nearest(state[..., :3], matrices)  # [*B, P, K, 7]
        distance, normal, point = places[..., 0], places[..., 1:4], places[..., 4:]
        at = BODY_STATE.slices
        arms, velocities = [], []
        for node in (self.first, self.second):
            body = state[..., node, :].unsqueeze(-2)  # [*B, P, 1, 13]
            arm = point - body[..., at["position"]]
            spin = body[..., at["angular_velocity"]].expand_as(arm)
            velocities.append(body[..., at["linear_velocity"]] + torch.linalg.cross(spin, arm))
            arms.append(arm)
        relative = velocities[1] - velocities[0]
        parting = (relative * normal).sum(-1)
        along = relative - parting.unsqueeze(-1) * normal
        fine = [1 - (each / _NEAR).clamp(-1, 1) for each in (distance, distance + self.timestep * parting)]
        share = ((_FAR - distance) / (_FAR - _NEAR)).clamp(0, 1).unsqueeze(-1)
        alike = torch.stack(((_FAR - distance).clamp(min=0), *fine, share.squeeze(-1) * parting), dim=-1)
        ends = [
            torch.cat((alike, share * torch.cat((sign * along, sign * normal, arm), dim=-1)), dim=-1).flatten(-2)
            for sign, arm in ((1, arms[1]), (-1, arms[0]))
        ]
        return pad(torch.stack(ends, dim=-2).flatten(-3, -2), (0, 0, self.joint_edges, 0))

    def nearest(self, position: Tensor, matrices: Tensor) -> Tensor:
        """Return each pair's nearest places ``[*B, P, K, 7]``: distance, normal from first to second node, position."""
        dtype = position.dtype
        start, direction, center, half = (
            each.to(dtype) for each in (self.start, self.direction, self.center, self.half_size)
        )
        rotation, radius, sign = self.rotation.to(dtype), self.radius.to(dtype), self.sign.to(dtype)
        segment, box = matrices[..., self.segment_node, :, :], matrices[..., self.box_node, :, :]  # [*B, C, 3, 3]
        origin = position[..., self.segment_node, :] + turned_by(segment, start)
        middle = position[..., self.box_node, :] + turned_by(box, center)
        frame = box @ rotation
        back, line = frame.mT, turned_by(segment, direction)
        near = segment_to_box(turned_by(back, origin - middle), turned_by(back, line), half)
        normal = turned_by(frame, near.normal)
        distance = near.distance - radius.sum(-1)
        # The place is midway between both surfaces.
        inwards = radius[:, 0] + 0.5 * distance
        point = origin + near.fraction.unsqueeze(-1) * line - inwards.unsqueeze(-1) * normal
        # Near its end, a segment ranks lower: both ends are candidates, and the other end may touch too.
        to_end = (0.5 - (near.fraction - 0.5).abs()) * torch.linalg.vector_norm(direction, dim=-1)
        rank = distance + self.tie.to(dtype) + torch.where(self.has_ends, (_SAME - to_end).clamp(min=0), 0.0)
        each = torch.cat((rank.unsqueeze(-1), distance.unsqueeze(-1), sign.unsqueeze(-1) * normal, point), dim=-1)
        return self._first(each)[..., 1:]

    def _first(self, each: Tensor) -> Tensor:
        """Return the ``K`` candidates of lowest rank for every pair, ``[*B, P, K, 8]``, from ``[*B, C, 8]``."""
        none = each.new_zeros(8)
        none[:2] = _NOWHERE
        nearest = [none.expand(*each.shape[:-2], self.rounds[0], 8)] * self.places
        for index, candidate in enumerate(each.split(self.rounds, dim=-2)):
            count = candidate.shape[-2]
            for rank in range(min(index, self.places)):
                now, others = nearest[rank][..., :count, :], nearest[rank][..., count:, :]
                closer = candidate[..., :1] < now[..., :1]
                nearest[rank] = torch.cat((torch.where(closer, candidate, now), others), dim=-2)
                candidate = torch.where(closer, now, candidate)
            if index < self.places:
                nearest[index] = torch.cat((candidate, nearest[index][..., count:, :]), dim=-2)
        return torch.stack(nearest, dim=-2)
