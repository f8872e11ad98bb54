"""Violations of constraints between joints or tendons as features of the coupled joints' edges."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal

import mujoco
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchrl_gn.dynamics.features.feature import Feature, StepInputs
from torchrl_gn.dynamics.joint_coordinates import JointCoordinates
from torchrl_gn.dynamics.tendon_states import TendonStates
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.state_layout import StateLayout
from torchrl_gn.scenes import Articulation, Scene
from torchrl_gn.scenes.couplings import coupled_joints, couplings
from torchrl_gn.scenes.tendons import tendon_joints, tendon_scales

if TYPE_CHECKING:
    from torchrl_gn.dynamics.features.canonical_state import BoundCanonicalizer

_NEAR_ANGLE, _NEAR_PLACE = 0.02, 0.002  # rad and metres: violations at which two features are clipped
_STEP = 0.02  # seconds: a rate's least scale is such a violation in this time
_OF_TENDON = 0.1  # the same for tendons, as a share of tendon_scales (the length change by 0.1 rad or 2 cm of a joint)
_SIZE = 5


@dataclass(frozen=True)
class Couplings(Feature):
    """Violation and rate of each constraint between joints or tendons, at the joints that it moves.

    For example, the fingers of a gripper mirror each other: the force on each depends on the other's coordinate, which
    is far away in the graph. Paper: the network sees no constraints.

    Not a default feature: it did not reduce errors where it was measured.
    """

    part: ClassVar[Literal["nodes", "edges"]] = "edges"

    per_joint: int = 1  # maximum number of couplings at one edge

    @staticmethod
    def suits(scene: object) -> bool:
        """Return True if a scene has active equality constraints of joints or tendons."""
        return isinstance(scene, Scene) and bool(scene.model.neq and couplings(scene)[0])

    def resolved(self, scene: Articulation) -> Couplings:
        return replace(self, per_joint=_per_joint(self.require_bodies(scene)))

    def size(self, layout: StateLayout) -> int:
        return _SIZE * self.per_joint

    def least_scales(self, layout: StateLayout) -> list[float]:
        # Data lie closer to the constraint than a model's predictions.
        return [_NEAR_ANGLE, 1.0, 1.0, _NEAR_ANGLE / _STEP, 0.0] * self.per_joint

    def bind(self, scene: Articulation, layout: StateLayout, canonicalizer: BoundCanonicalizer) -> nn.Module:
        scene = self.require_bodies(scene)
        if (slots := _per_joint(scene)) > self.per_joint:
            raise ValueError(
                f"The model reads {self.per_joint} couplings at each edge, scene {scene.name!r} has {slots}: build the"
                " model with ForwardModel.for_scene."
            )
        return _Bound(scene, self.per_joint)


def _per_joint(scene: Scene) -> int:
    joints = [joint for each in couplings(scene)[0] for joint in coupled_joints(scene, each)]
    return int(np.bincount(joints).max(initial=1)) if joints else 1


class _Bound(Float64Buffers):
    coordinate: Tensor
    ends: Tensor
    start: Tensor
    polynomial: Tensor
    near: Tensor
    has_second: Tensor
    which: Tensor
    arms: Tensor
    place: Tensor

    def __init__(self, scene: Scene, per_joint: int) -> None:
        super().__init__()
        model, supported = scene.model, couplings(scene)[0]
        self.timestep, self.edges, self.count, self.per_joint = (
            float(scene.timestep),
            2 * model.njnt,
            len(supported),
            per_joint,
        )
        if not supported:
            return
        self.coordinates = JointCoordinates(scene, partly=True)
        tendons = sorted(
            {end for each in supported if each.couples_tendons for end in (each.first, each.second) if end >= 0}
        )
        pulled = [(tendon, joint) for tendon in tendons for joint in tendon_joints(scene, tendon)]
        self.tendons = TendonStates(scene, tendons, pulled) if tendons else None
        # Indices into the coordinates of all joints, then lengths of tendons, then a 0.
        nothing, moment = model.njnt + len(tendons), len(pulled) + 1
        places = [
            [nothing if end < 0 else model.njnt + tendons.index(end) if each.couples_tendons else end for end in ends]
            for each in supported
            for ends in [(each.first, each.second)]
        ]
        starts = [*model.qpos0[model.jnt_qposadr], *model.tendon_length0[tendons], 0.0]
        slots: list[list[int]] = [[] for _ in range(model.njnt)]
        which, arms = [], []
        for index, each in enumerate(supported):
            for joint in coupled_joints(scene, each):
                slots[joint].append(len(which))
                which.append(index)
                # Index of both ends' moments at the joint, among those of tendons, then a joint's own 1, then a 0.
                arms.append(
                    [
                        (pulled.index((end, joint)) if (end, joint) in pulled else moment)
                        if each.couples_tendons
                        else len(pulled)
                        if end == joint
                        else moment
                        for end in (each.first, each.second)
                    ]
                )
        place = np.array([[*some, *[len(which)] * (per_joint - len(some))] for some in slots], dtype=np.int64)
        place = place.reshape(-1, per_joint)
        turns = model.jnt_type == int(mujoco.mjtJoint.mjJNT_HINGE)
        scales = tendon_scales(model) if tendons else np.zeros(0)
        self.constants(
            {
                "ends": np.array(places).T.copy(),
                "start": np.array(starts)[np.array(places).T],
                "polynomial": model.eq_data[[each.equality for each in supported], :5].T.copy(),
                "has_second": np.array([each.second >= 0 for each in supported]),
                "near": np.array(
                    [
                        _OF_TENDON * scales[each.first]
                        if each.couples_tendons
                        else (_NEAR_ANGLE if turns[each.first] else _NEAR_PLACE)
                        for each in supported
                    ]
                ),
                "which": np.array(which, dtype=np.int64),
                "arms": np.array(arms, dtype=np.int64).reshape(-1, 2).T.copy(),
                "place": place,
            }
        )

    def forward(self, inputs: StepInputs) -> Tensor:
        """Return features ``[*B, 2 J, 5 C]`` of the joints' edges.

        For each coupling at a joint: its violation (rad or metres); the violations now and a step later, clipped and
        scaled to 1; its rate; and its derivative by the joint's coordinate. Violations are clipped to 0.02 rad or 2 mm;
        those of tendons to the length change by 0.01 rad or 2 mm of a joint.
        """
        state, matrices = inputs.canonical[:2]
        assert matrices is not None
        if not self.count:
            return state.new_zeros((*state.shape[:-2], self.edges, _SIZE * self.per_joint))
        joint = inputs.parameters.joint[..., : self.edges : 2, :]
        joints = self.coordinates.joints(state, matrices, inputs.parameters.joint_pose, joint)
        coordinate, rate, moment = joints.coordinate, joints.rate, joints.rate[..., :0]
        if self.tendons is not None:
            tendons = self.tendons(state, matrices, joints)
            coordinate, rate = (
                torch.cat((coordinate, tendons.length), dim=-1),
                torch.cat((rate, tendons.velocity), dim=-1),
            )
            moment = tendons.moment
        coordinate, rate = pad(coordinate, (0, 1)), pad(rate, (0, 1))
        moment = pad(pad(moment, (0, 1), value=1.0), (0, 1))
        start, (first, second) = self.start.to(state.dtype), self.ends
        away = coordinate[..., second] - start[1]
        constants = self.polynomial.to(state.dtype)
        value, slope = constants[4] + torch.zeros_like(away), torch.zeros_like(away)
        for constant in constants[:4].flip(0):
            value, slope = value * away + constant, slope * away + value
        slope = torch.where(self.has_second, slope, 0.0)
        violation = coordinate[..., first] - start[0] - torch.where(self.has_second, value, constants[0])
        change = rate[..., first] - slope * rate[..., second]
        near = self.near.to(state.dtype)
        fine = [(each / near).clamp(-1, 1) for each in (violation, violation + self.timestep * change)]
        each = torch.stack((violation, *fine, change), dim=-1)[..., self.which, :]
        arm = moment[..., self.arms[0]] - slope[..., self.which] * moment[..., self.arms[1]]
        each = torch.cat((each, arm.unsqueeze(-1)), dim=-1)
        return pad(each, (0, 0, 0, 1))[..., self.place, :].flatten(-2).repeat_interleave(2, dim=-2)
