"""Coordinates, rates and limits of joints as features of their edges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from torchrl_gn.dynamics.features.feature import CLIPPED_SCALE, Feature, StepInputs
from torchrl_gn.dynamics.joint_coordinates import JointCoordinates
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.state_layout import StateLayout
from torchrl_gn.scenes.force_elements import limited_joints, sprung

if TYPE_CHECKING:
    from torchrl_gn.dynamics.features.canonical_state import BoundCanonicalizer
    from torchrl_gn.scenes import Articulation, Scene

_NEAR_ANGLE, _NEAR_PLACE = 0.1, 0.02  # rad and metres: distance from a limit at which its features are clipped
_SLOW = 0.05  # rad/s or m/s: rate at which the feature for dry friction is clipped
_SIZE = 9


@dataclass(frozen=True)
class Joints(Feature):
    """Each joint's coordinate and rate, and its distances from both limits.

    Limits, springs and friction act on coordinates, which the network need not compute from two rotation matrices.
    Paper: the network sees bodies alone.
    """

    part: ClassVar[Literal["nodes", "edges"]] = "edges"

    def size(self, layout: StateLayout) -> int:
        return _SIZE

    def least_scales(self, layout: StateLayout) -> list[float]:
        return [0.0] * 4 + [CLIPPED_SCALE] * 5  # data may hardly reach a limit

    def bind(self, scene: Articulation, layout: StateLayout, canonicalizer: BoundCanonicalizer) -> nn.Module:
        scene = self.require_bodies(scene)
        return _Bound(scene)


class _Bound(Float64Buffers):
    shown: Tensor
    near: Tensor
    limited: Tensor
    rubs: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        model = scene.model
        self.timestep, self.edges = float(scene.timestep), 2 * model.njnt
        self.coordinates = JointCoordinates(scene, partly=True)
        kinds, turns = model.jnt_type, (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_BALL))
        limited = limited_joints(model) & self.coordinates.known.numpy()
        springs = sprung(model, "jnt")
        self.constants(
            {
                "near": np.where(np.isin(kinds, turns), _NEAR_ANGLE, _NEAR_PLACE),
                # Coordinates on which no force depends are left out: they would only break an invariance.
                "shown": (limited | springs).astype(float),
                "limited": limited.astype(float),
                "rubs": (model.dof_frictionloss[model.jnt_dofadr] > 0).astype(float),
            }
        )

    def forward(self, inputs: StepInputs) -> Tensor:
        """Return features ``[*B, 2 J, 9]`` of the joints' edges; 0 if coordinates do not follow from body states.

        For each joint: sine and cosine of its angle; its coordinate (rad or m), if it has limits or a spring; its rate;
        the distances from its lower and upper limit, now and a step later, clipped to 0.1 rad or 2 cm and scaled to 1;
        and its rate, if it has dry friction, clipped to 0.05 rad/s or m/s and scaled to 1.
        """
        state, matrices = inputs.canonical[:2]
        assert matrices is not None
        if not self.edges:
            return state.new_zeros((*state.shape[:-2], 0, _SIZE))
        joint = inputs.parameters.joint[..., : self.edges : 2, :].to(state.dtype)
        joint_states = self.coordinates.joints(state, matrices, inputs.parameters.joint_pose, joint)
        shown, limited, near, rubs = (each.to(state.dtype) for each in (self.shown, self.limited, self.near, self.rubs))
        soon = joint_states.coordinate + self.timestep * joint_states.rate
        low, high = joint[..., 6], joint[..., 7]
        margins = [each for at in (joint_states.coordinate, soon) for each in (at - low, high - at)]
        features = (
            *(joint_states.sine, joint_states.cosine, shown * joint_states.coordinate, joint_states.rate),
            *(limited * (margin / near).clamp(-1, 1) for margin in margins),
            rubs * (joint_states.rate / _SLOW).clamp(-1, 1),
        )
        return torch.stack(features, dim=-1).repeat_interleave(2, dim=-2)
