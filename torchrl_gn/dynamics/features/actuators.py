"""Forces of servos and other actuators, by their laws in MuJoCo, as features of the edges where they act."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal

import mujoco
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchrl_gn.dynamics.features.controls import controls_per_edge, require_slots
from torchrl_gn.dynamics.features.feature import CLIPPED_SCALE, Feature, StepInputs
from torchrl_gn.dynamics.joint_coordinates import JointCoordinates
from torchrl_gn.dynamics.joint_moments import LinesAtJoints
from torchrl_gn.dynamics.lines import Lines
from torchrl_gn.dynamics.muscle_forces import MuscleForces
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.state_layout import StateLayout
from torchrl_gn.scenes import Articulation, Scene
from torchrl_gn.scenes.activations import muscle_actuators
from torchrl_gn.scenes.actuator_kinds import turning_servos
from torchrl_gn.scenes.force_elements import FAR, actuator_laws, line_actuators, site_actuators
from torchrl_gn.scenes.lines import moved_joints
from torchrl_gn.scenes.topology import topology

if TYPE_CHECKING:
    from torchrl_gn.dynamics.features.canonical_state import BoundCanonicalizer

_NEAR = (0.05, 0.005)  # rad or m, rad/s or m/s of a velocity servo: errors at which two features are clipped
_SIZE = 4
_AT_BODIES = (int(mujoco.mjtTrn.mjTRN_SITE), int(mujoco.mjtTrn.mjTRN_BODY))


@dataclass(frozen=True)
class Actuators(Feature):
    """Force of each actuator by its law in MuJoCo, and a servo's error.

    A stiff servo's force depends on angle differences that are too small for a network to resolve. The force of a
    spatial tendon or slider-crank appears at each joint that it moves, times its moment arm there, as a joint motor's
    does. Paper: the network sees the control alone.
    """

    part: ClassVar[Literal["nodes", "edges"]] = "edges"

    per_joint: int = 1  # maximum number of controls at one edge

    @staticmethod
    def suits(scene: object) -> bool:
        """Return True if a scene has actuators whose force at their edges is not proportional to the control."""
        if not isinstance(scene, Scene):
            return False
        if scene.delays.size:
            return True
        laws = actuator_laws(scene)
        limits = np.abs(laws[..., 6:8])
        pulling = set(line_actuators(scene)) - set(site_actuators(scene.model))  # their moment arms vary
        contracts = laws[np.isin(scene.edge_action, np.flatnonzero(muscle_actuators(scene.model))), 8].any()
        return bool(pulling or contracts or (laws[..., 1:6] != 0).any() or ((limits > 0) & (limits < FAR)).any())

    def resolved(self, scene: Articulation) -> Actuators:
        return replace(self, per_joint=controls_per_edge(scene))

    def size(self, layout: StateLayout) -> int:
        return _SIZE * self.per_joint

    def least_scales(self, layout: StateLayout) -> list[float]:
        return [0.0, 0.0, CLIPPED_SCALE, CLIPPED_SCALE] * self.per_joint  # a servo's error may hardly vary in data

    def bind(self, scene: Articulation, layout: StateLayout, canonicalizer: BoundCanonicalizer) -> nn.Module:
        scene = self.require_bodies(scene)
        require_slots(scene, self.per_joint, "actuators at each edge")
        return _Bound(scene)


class _Bound(Float64Buffers):
    sums: Tensor
    bound_low: Tensor
    bound_high: Tensor
    holds: Tensor
    is_servo: Tensor
    line: Tensor
    moment: Tensor
    no_line: Tensor
    activated: Tensor
    activation: Tensor
    is_muscle: Tensor
    turns: Tensor
    per_radian: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        model = scene.model
        self.timestep, self.joints, self.pairs = float(scene.timestep), int(model.njnt), len(scene.pairs)
        self.coordinates = JointCoordinates(scene, partly=True)
        action = scene.edge_action[::2]  # [P, C]
        # For each slot, sum over all slots of the same actuator: [P * C, P * C].
        flat = action.reshape(-1)
        sums = ((flat[:, None] == flat[None, :]) & (flat[:, None] >= 0)).astype(float)
        # A joint limits the total force of its actuators; applied here only to joints with one actuator.
        bounds = np.tile([-FAR, FAR], (self.pairs, 1))
        has = model.jnt_actfrclimited.astype(bool) & ((action[: model.njnt] >= 0).sum(1) == 1)
        has[_moved_from_afar(scene, action)] = False
        has &= ~(model.jnt_actgravcomp.astype(bool) & model.body_gravcomp.any())  # a part of the total, unknown here
        bounds[: model.njnt][has] = model.jnt_actfrcrange[has]
        self.constants({"sums": sums, "bound_low": bounds[:, :1], "bound_high": bounds[:, 1:]})
        laws = actuator_laws(scene)[::2]
        holds, acts = laws[..., 4] != 0, laws[..., 8] != 0  # holds a position; has a known force
        self.lines = self._lines(scene, action)
        muscles = np.isin(action, np.flatnonzero(muscle_actuators(model)))
        self.muscles = MuscleForces(model, np.where(muscles, action, -1)) if muscles.any() else None
        driven = np.where(action >= 0, np.append(model.actuator_actadr + model.actuator_actnum - 1, -1)[action], -1)
        driven[np.append(model.actuator_actadr, -1)[action] < 0] = -1
        self.any_driven = bool((driven >= 0).any())
        driving = {"activated": driven >= 0, "activation": np.where(driven >= 0, driven, model.na)}
        self.constants({**driving, "is_muscle": muscles})
        per_radian = np.append(turning_servos(model), 0.0)[action]  # -1: no actuator
        self.any_turns = bool(per_radian.any())
        self.constants({"turns": per_radian > 0, "per_radian": np.where(per_radian > 0, per_radian, 1.0)})
        self.constants({"holds": holds, "is_servo": acts & (holds | (laws[..., 5] != 0))})

    def _lines(self, scene: Scene, action: np.ndarray) -> LinesAtJoints | None:
        """Register which line is in which slot, and return the lines; None without lines."""
        lines = line_actuators(scene)
        if not lines:
            return None
        model, sites = scene.model, site_actuators(scene.model)
        pulled = [each for each in lines if model.actuator_trntype[each] == int(mujoco.mjtTrn.mjTRN_TENDON)]
        order = [*pulled, *(each for each in lines if each not in pulled)]
        slots = [
            (order.index(each), joint) for joint, row in enumerate(action.tolist()) for each in row if each in order
        ]
        at_joints = [(line, joint) for line, joint in slots if order[line] not in sites]
        # After the lines a length of 0 is appended, for slots without line; after the moments a 1, for sites.
        line, moment = (np.full(action.shape, count) for count in (len(order), len(at_joints)))
        for (joint, slot), actuator in np.ndenumerate(action):
            if actuator in order:
                line[joint, slot] = order.index(actuator)
                if actuator not in sites:
                    moment[joint, slot] = at_joints.index((order.index(actuator), joint))
        self.constants({"line": line, "moment": moment, "no_line": torch.as_tensor(line == len(order))})
        tendons = model.actuator_trnid[pulled, 0].tolist()
        return LinesAtJoints(scene, Lines(scene, tendons, order[len(pulled) :]), at_joints)

    def _drives(self, inputs: StepInputs) -> tuple[Tensor, Tensor]:
        """Return each actuator's input ``[*B, P, C]``, its control or activation: now, and a step later."""
        ends = (inputs.controls, inputs.controls) if inputs.ends is None else inputs.ends
        first, later = (each[..., ::2, :] for each in ends)
        step = inputs.canonical.activations
        if step is None or not self.any_driven:
            return first, later
        first, later = (
            torch.where(self.activated, pad(each, (0, 1))[..., self.activation], control)
            for each, control in ((step.now, first), (step.later, later))
        )
        return first, later

    def forward(self, inputs: StepInputs) -> Tensor:
        """Return features ``[*B, E, 4 C]``; 0 for an actuator whose force does not follow from body states.

        For each actuator at an edge: its force or torque there, now and a step later (N or N m; at balls, free joints
        and sites, the force along its line); and a servo's error, clipped to 0.05 and to 0.005 of its unit and scaled
        to 1.
        """
        state, matrices = inputs.canonical[:2]
        assert matrices is not None
        law = inputs.parameters.actuator[..., ::2, :, :].to(state.dtype)  # [*B, P, C, 9]
        joint = inputs.parameters.joint[..., : 2 * self.joints : 2, :]
        joint_states = self.coordinates.joints(state, matrices, inputs.parameters.joint_pose, joint)
        missing = self.pairs - self.joints
        gain, bias, gear = law[..., :3], law[..., 3:6], law[..., 8]
        drives, sums = self._drives(inputs), self.sums.to(state.dtype)
        coordinate, rate = (
            pad(each, (0, missing)).unsqueeze(-1) for each in (joint_states.coordinate, joint_states.rate)
        )
        length, velocity = (((each * gear).flatten(-2) @ sums).view(drives[0].shape) for each in (coordinate, rate))
        arm = gear
        if self.lines is not None:
            pulls = self.lines(state, matrices, joint_states)
            here, rate = (gear * pad(each, (0, 1))[..., self.line] for each in (pulls.length, pulls.velocity))
            length, velocity = torch.where(self.no_line, length, here), torch.where(self.no_line, velocity, rate)
            arm = gear * torch.where(self.no_line, 1.0, pad(pulls.moment, (0, 1), value=1.0)[..., self.moment])
        low, high = self.bound_low.to(state.dtype), self.bound_high.to(state.dtype)
        forces, free = [], []
        for at, drive in zip((length, length + self.timestep * velocity), drives, strict=True):
            if self.any_turns:
                away = (drive - at) / self.per_radian.to(state.dtype)
                nearest = self.per_radian.to(state.dtype) * torch.atan2(away.sin(), away.cos())
                drive = torch.where(self.turns, at + nearest, drive)
            scale = gain[..., 0] + gain[..., 1] * at + gain[..., 2] * velocity
            if self.muscles is not None:
                scale = torch.where(self.is_muscle, self.muscles.gain(at, velocity), scale)
            force = scale * drive + bias[..., 0] + bias[..., 1] * at + bias[..., 2] * velocity
            if self.muscles is not None:
                force = torch.where(self.is_muscle, force + self.muscles.bias(at), force)
            free.append(force)
            clipped = torch.minimum(torch.maximum(force, law[..., 6]), law[..., 7])
            forces.append((arm * clipped).clamp(low, high))
        # Distance of the joint's or tendon's coordinate, or of its rate, from where the servo exerts no force.
        unit = (torch.where(self.holds, bias[..., 1], bias[..., 2]) * gear).abs()
        error = torch.where(self.is_servo, free[0] / torch.where(self.is_servo, unit, 1.0), 0.0)
        parts = [*forces, *((error / near).clamp(-1, 1) for near in _NEAR)]
        return torch.stack(parts, dim=-1).flatten(-2).repeat_interleave(2, dim=-2)


def _moved_from_afar(scene: Scene, action: np.ndarray) -> list[int]:
    """Return joints moved by actuators of sites or of adhesive bodies, which act at pairs ``[P, C]`` of bodies."""
    afar = np.flatnonzero(np.isin(scene.model.actuator_trntype, _AT_BODIES))
    ends = [scene.pairs[pair] for pair in np.flatnonzero(np.isin(action, afar).any(1))]
    return moved_joints(topology(scene.model), [(pair.first, pair.second) for pair in ends])
