"""Forces of servos and other actuators with laws of their own as features of the edges at which they act."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchrl_gn.dynamics.features.controls import controls_per_edge, require_slots
from torchrl_gn.dynamics.features.feature import Feature, StepInputs
from torchrl_gn.dynamics.joint_coordinates import JointCoordinates
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.state_layout import StateLayout
from torchrl_gn.scenes import Scene
from torchrl_gn.scenes.force_elements import FAR, actuator_laws, winding_joints

if TYPE_CHECKING:
    from torchrl_gn.dynamics.features.canonical_state import BoundCanonicalizer

_NEAR = (0.05, 0.005)  # rad, m, or rad/s or m/s of a velocity servo: errors up to which two features vary
_SIZE = 4


@dataclass(frozen=True)
class Actuators(Feature):
    """Force of each actuator by its law in MuJoCo, and a servo's error.

    A stiff servo's force depends on angles finer than a network resolves. Paper: it sees the control alone.
    """

    part: ClassVar[Literal["nodes", "edges"]] = "edges"

    per_joint: int = 1  # most controls that act at one edge

    @staticmethod
    def suits(scene: object) -> bool:
        """Whether a scene has actuators whose force is not proportional to the control."""
        if not isinstance(scene, Scene):
            return False
        laws = actuator_laws(scene)
        limits = np.abs(laws[..., 6:8])
        return bool((laws[..., 1:6] != 0).any() or ((limits > 0) & (limits < FAR)).any())

    def resolved(self, scene: Scene) -> Actuators:
        return replace(self, per_joint=controls_per_edge(scene))

    def size(self, layout: StateLayout) -> int:
        return _SIZE * self.per_joint

    def bind(self, scene: Scene, layout: StateLayout, canonicalizer: BoundCanonicalizer) -> nn.Module:
        self.require_bodies(scene, layout)
        require_slots(scene, self.per_joint, "actuators at each edge")
        return _Bound(scene)


class _Bound(Float64Buffers):
    sums: Tensor
    bound_low: Tensor
    bound_high: Tensor
    winds: Tensor
    holds: Tensor
    is_servo: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        model = scene.model
        self.timestep, self.joints, self.pairs = float(scene.timestep), int(model.njnt), len(scene.pairs)
        self.coordinates = JointCoordinates(scene, partly=True)
        action = scene.edge_action[::2]  # [P, C]
        # Sums over the places of each actuator, seen from each of its slots: [P * C, P * C].
        flat = action.reshape(-1)
        sums = ((flat[:, None] == flat[None, :]) & (flat[:, None] >= 0)).astype(float)
        # The force of all actuators of a joint has limits of its own, here where there is one.
        bounds = np.tile([-FAR, FAR], (self.pairs, 1))
        has = model.jnt_actfrclimited.astype(bool) & ((action[: model.njnt] >= 0).sum(1) == 1)
        bounds[: model.njnt][has] = model.jnt_actfrcrange[has]
        self.constants({"sums": sums, "bound_low": bounds[:, :1], "bound_high": bounds[:, 1:]})
        # Body states do not show whole turns: a servo's joint that may make some is taken to be near its target.
        winds = np.zeros(action.shape, dtype=bool)
        winds[: model.njnt] = winding_joints(scene)[:, None]
        laws = actuator_laws(scene)[::2]
        holds, acts = laws[..., 4] != 0, laws[..., 8] != 0  # a position; at all
        winds &= holds & acts & (sums.sum(1) == 1).reshape(action.shape)
        self.any_winds = bool(winds.any())
        self.constants({"winds": winds, "holds": holds, "is_servo": acts & (holds | (laws[..., 5] != 0))})

    def forward(self, inputs: StepInputs) -> Tensor:
        """Features ``[*B, E, 4 C]``; 0 of an actuator whose force does not follow from joint coordinates.

        Of each actuator at an edge: its force or torque there, now and a step on (N or N m), and a servo's error,
        clipped to 0.05 and to 0.005 of its joint's unit and scaled to 1.
        """
        state, matrices = inputs.canonical[:2]
        assert matrices is not None
        law = inputs.parameters.actuator[..., ::2, :, :].to(state.dtype)  # [*B, P, C, 9]
        joint = inputs.parameters.joint[..., : 2 * self.joints : 2, :]
        found = self.coordinates.joints(state, matrices, inputs.parameters.joint_pose, joint)
        missing = self.pairs - self.joints
        gain, bias, gear = law[..., :3], law[..., 3:6], law[..., 8]
        control, sums = inputs.controls[..., ::2, :], self.sums.to(state.dtype)
        coordinate, rate = (pad(each, (0, missing)).unsqueeze(-1) for each in (found.coordinate, found.rate))
        if self.any_winds:
            slope = bias[..., 1] * gear
            away = (gain[..., 0] * control + bias[..., 0]) / torch.where(self.winds, -slope, 1.0) - coordinate
            nearest = coordinate + away - torch.atan2(away.sin(), away.cos())
            coordinate = torch.where(self.winds, nearest, coordinate)
        length, velocity = (((each * gear).flatten(-2) @ sums).view(control.shape) for each in (coordinate, rate))
        low, high = self.bound_low.to(state.dtype), self.bound_high.to(state.dtype)
        forces, free = [], []
        for at in (length, length + self.timestep * velocity):
            scale = gain[..., 0] + gain[..., 1] * at + gain[..., 2] * velocity
            force = scale * control + bias[..., 0] + bias[..., 1] * at + bias[..., 2] * velocity
            free.append(force)
            clipped = torch.minimum(torch.maximum(force, law[..., 6]), law[..., 7])
            forces.append((gear * clipped).clamp(low, high))
        # How far the joint, or its rate, is from where the servo exerts nothing.
        unit = (torch.where(self.holds, bias[..., 1], bias[..., 2]) * gear).abs()
        error = torch.where(self.is_servo, free[0] / torch.where(self.is_servo, unit, 1.0), 0.0)
        parts = [*forces, *((error / near).clamp(-1, 1) for near in _NEAR)]
        return torch.stack(parts, dim=-1).flatten(-2).repeat_interleave(2, dim=-2)
