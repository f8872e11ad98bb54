"""Lengths, limits, springs and moment arms of tendons as features of the edges of the joints that they move."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchrl_gn.dynamics.features.feature import CLIPPED_SCALE, Feature, StepInputs
from torchrl_gn.dynamics.joint_coordinates import JointCoordinates
from torchrl_gn.dynamics.tendon_states import TendonStates
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.state_layout import StateLayout
from torchrl_gn.scenes import Articulation, Scene
from torchrl_gn.scenes.force_elements import FAR, straight_joints
from torchrl_gn.scenes.tendons import acting_tendons, tendon_joints, tendon_laws, tendon_scales

if TYPE_CHECKING:
    from torchrl_gn.dynamics.features.canonical_state import BoundCanonicalizer

_SLOW = 0.5  # 1/s: rate, relative to a tendon's tendon_scales, at which the feature for dry friction is clipped


@dataclass(frozen=True)
class Tendons(Feature):
    """Length, rate, limits, spring and moment arm of each tendon at the joints that it moves.

    A tendon's forces on the bodies along its path add up to a moment at each joint that it moves. So tendons need no
    further edges and look like other joint forces. Paper: the network sees no tendons.
    """

    part: ClassVar[Literal["nodes", "edges"]] = "edges"

    per_joint: int = 1  # maximum number of tendons at one edge
    vectors: bool = False  # also forces and torques at balls and free joints

    @staticmethod
    def suits(scene: object) -> bool:
        """Return True if tendons have limits, springs, damping or friction, or pull at balls or free joints."""
        return isinstance(scene, Scene) and bool(scene.model.ntendon and acting_tendons(scene)[0])

    def resolved(self, scene: Articulation) -> Tendons:
        scene = self.require_bodies(scene)
        return replace(self, per_joint=max(1, _slots(scene).shape[1]), vectors=_needs_vectors(scene))

    def size(self, layout: StateLayout) -> int:
        return feature_size(self.vectors) * self.per_joint

    def least_scales(self, layout: StateLayout) -> list[float]:
        each = [0.0] * 2 + [CLIPPED_SCALE] * 4 + [0.0] * 2 + [CLIPPED_SCALE]  # data may hardly reach a limit
        return [*each, *[0.0] * (feature_size(self.vectors) - len(each))] * self.per_joint

    def bind(self, scene: Articulation, layout: StateLayout, canonicalizer: BoundCanonicalizer) -> nn.Module:
        scene = self.require_bodies(scene)
        resolved = self.resolved(scene)
        if resolved.per_joint > self.per_joint or resolved.vectors > self.vectors:
            where = "" if self.vectors else ", of no balls or free joints"
            raise ValueError(
                f"The model reads {self.per_joint} tendons at each edge{where},"
                f" scene {scene.name!r} has more: build the model with ForwardModel.for_scene."
            )
        return _Bound(scene, self.per_joint, self.vectors)


def _needs_vectors(scene: Scene) -> bool:
    straight = straight_joints(scene)
    return any(not straight[tendon_joints(scene, tendon)].all() for tendon in acting_tendons(scene)[0])


def _slots(scene: Scene) -> np.ndarray:
    """Return the tendon in each slot of each joint ``[J, C]``, -1 without."""
    at: list[list[int]] = [[] for _ in range(scene.model.njnt)]
    for tendon in acting_tendons(scene)[0]:
        for joint in tendon_joints(scene, tendon):
            at[joint].append(tendon)
    most = max(map(len, at), default=0)
    return np.array([[*some, *[-1] * (most - len(some))] for some in at], dtype=int).reshape(len(at), most)


class _Bound(Float64Buffers):
    law: Tensor
    rest: Tensor
    near: Tensor
    limited: Tensor
    shown: Tensor
    rubs: Tensor
    tendon: Tensor
    place: Tensor

    def __init__(self, scene: Scene, per_joint: int, vectors: bool) -> None:
        super().__init__()
        model, slots, known = scene.model, _slots(scene), acting_tendons(scene)[0]
        self.timestep, self.per_joint, self.vectors = float(scene.timestep), per_joint, vectors
        self.edges, self.known = 2 * model.njnt, len(known)
        if not known:
            return
        at = [(tendon, joint) for joint, row in enumerate(slots.tolist()) for tendon in row if tendon >= 0]
        self.coordinates, self.tendons = JointCoordinates(scene, partly=True), TendonStates(scene, known, at)
        laws = tendon_laws(model)[known]
        # Empty slots read a 0 that is appended to all others.
        place = np.full((len(slots), per_joint), len(at))
        place[:, : slots.shape[1]][slots >= 0] = np.arange(len(at))
        limited, springs = (np.abs(laws[:, :2]) < FAR).any(1), laws[:, 4] != 0
        self.constants(
            {
                "law": laws.T.copy(),
                "rest": model.tendon_length0[known],
                "near": tendon_scales(model)[known],
                "limited": limited.astype(float),
                "shown": (limited | springs).astype(float),
                "rubs": (laws[:, 6] > 0).astype(float),
                "tendon": np.array([known.index(tendon) for tendon, _ in at]),
                "place": place,
            }
        )

    def forward(self, inputs: StepInputs) -> Tensor:
        """Return features ``[*B, 2 J, 10 C]``, or ``[*B, 2 J, 16 C]`` with vectors, of the joints' edges.

        For each tendon at a joint, in this order:

        - its length less that in the reference pose (metres; rad for fixed tendons of hinges), if it has limits or a
          spring, and its rate;
        - the distances from both limits, now and a step later, clipped to the length change by 0.1 rad or 2 cm of a
          joint and scaled to 1;
        - force or torque of spring and damper at the joint, now and a step later;
        - its rate, if it has dry friction, clipped;
        - its moment at the joint, 1 for a ball or free joint;
        - with vectors: force and torque at a ball or free joint, in the canonical frame.
        """
        state, matrices = inputs.canonical[:2]
        assert matrices is not None
        size = feature_size(self.vectors)
        if not self.known:
            return state.new_zeros((*state.shape[:-2], self.edges, size * self.per_joint))
        joint = inputs.parameters.joint[..., : self.edges : 2, :]
        joints = self.coordinates.joints(state, matrices, inputs.parameters.joint_pose, joint)
        length, rate, moment, vector = self.tendons(state, matrices, joints)
        low, high, relaxed, tight, stiffness, damping, _ = self.law.to(state.dtype)
        near, limited, shown, rubs, rest = (
            each.to(state.dtype) for each in (self.near, self.limited, self.shown, self.rubs, self.rest)
        )
        soon = length + self.timestep * rate
        margins = [each for at in (length, soon) for each in (at - low, high - at)]
        stretched = [at - torch.minimum(torch.maximum(at, relaxed), tight) for at in (length, soon)]
        forces = [-stiffness * each - damping * rate for each in stretched]
        parts = (
            *(shown * (length - rest), rate),
            *(limited * (margin / near).clamp(-1, 1) for margin in margins),
            *forces,
            rubs * (rate / (_SLOW * near)).clamp(-1, 1),
        )
        each = torch.stack(parts, dim=-1)[..., self.tendon, :]  # [*B, K, 9]
        arm = moment.unsqueeze(-1)
        each = torch.cat((each[..., :6], arm * each[..., 6:8], each[..., 8:], arm), dim=-1)
        each = torch.cat((each, vector), dim=-1) if self.vectors else each
        return pad(each, (0, 0, 0, 1))[..., self.place, :].flatten(-2).repeat_interleave(2, dim=-2)


def feature_size(vectors: bool) -> int:
    """Return the number of features of a tendon at a joint."""
    return 16 if vectors else 10
