"""Canonical states: recentred along axes of translation invariance, rotated to the yaw frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchrl_gn.maths import quaternion
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.state_layout import StateLayout

if TYPE_CHECKING:
    from torchrl_gn.dynamics.activation_laws import ActivationStep
    from torchrl_gn.dynamics.delayed_controls import DelayStep
    from torchrl_gn.scenes import Articulation
    from torchrl_gn.scenes.physical_parameters import PhysicalParameters
    from torchrl_gn.scenes.yaw_frame import YawFrame


# Norm of the twist, which is the cosine of half the tilt, below which the yaw is 0.
_UPSIDE_DOWN = 1e-6


class FrameRotation(NamedTuple):
    """Rotation from the yaw frame to the world."""

    quaternion: Tensor  # [*B, 4]
    matrix: Tensor  # [*B, 3, 3]


class CanonicalState(NamedTuple):
    """A state in the canonical frame."""

    state: Tensor  # [*B, N, 13] recentred, at yaw 0
    matrices: Tensor | None  # [*B, N, 3, 3] rotation matrices of its orientations; None without orientations
    rotation: FrameRotation | None  # from the yaw frame to the world; None without a yaw frame
    change: Tensor | None = None  # [*B, N, 12] change by known physics, in this frame; None without physics
    activations: ActivationStep | None = None  # activations in this step; None without activations
    delays: DelayStep | None = None  # controls that act in this step, clipped; None without delays
    unwrapped: Tensor | None = None  # [*B, N, K] change of the unwrapped angles; None without such angles


@dataclass(frozen=True)
class Canonicalizer:
    """Options of canonical states, which make predictions invariant to a scene's position and rotation.

    If the root can tilt, its yaw is the twist of its orientation, relative to rest, about the yaw axis (swing-twist
    decomposition). Any yaw of a freely rotating body has a discontinuity. The discontinuity of this yaw is where the
    body is upside down, farthest from rest. Within 2e-6 rad of that pose, the yaw is 0 and has no gradient; elsewhere
    the gradient grows with the inverse of the distance from it.
    """

    # Recentre along axes of translation invariance. Paper, SM "System invariance": off when several systems train
    # together.
    recenter: bool = True
    yaw: bool = True  # rotate to the yaw frame of a scene that has one; paper: no
    # If no direction matters (no gravity, no surface), rotate to the root's whole orientation instead of its yaw.
    full_rotation: bool = True

    @classmethod
    def from_description(cls, description: Mapping[str, bool]) -> Canonicalizer:
        """Rebuild the options from ``dataclasses.asdict``. Descriptions of older versions have no full rotation."""
        return cls(**{"full_rotation": False, **description})

    def frame(self, scene: Articulation) -> YawFrame | None:
        """Return the yaw frame that states of a scene are rotated to, or None."""
        frame = scene.yaw_frame if self.yaw else None
        return frame.about(2) if frame is not None and frame.axis is None and not self.full_rotation else frame

    def bind(self, scene: Articulation, layout: StateLayout) -> BoundCanonicalizer:
        """Return the canonicaliser of one scene."""
        return BoundCanonicalizer(self, scene, layout)


class BoundCanonicalizer(Float64Buffers):
    """Canonicaliser of one scene."""

    predicted: Tensor
    shifted: Tensor

    def __init__(self, options: Canonicalizer, scene: Articulation, layout: StateLayout) -> None:
        super().__init__()
        self.layout = layout
        self.yaw_frame = frame = options.frame(scene)
        # True if the root can tilt, and so be upside down.
        self.tilts = frame is not None and bool(np.delete(scene.movable[frame.node, 3:6], frame.axes).any())
        predicted = torch.as_tensor(scene.predicted, dtype=torch.float64)
        invariant = torch.as_tensor(scene.translation_invariant, dtype=torch.float64)
        self.recenters = bool(options.recenter and invariant.any() and predicted.any())
        # 1 for positions that move when the scene is shifted, [N, 3]; the world stays at 0.
        self.constants({"predicted": predicted, "shifted": predicted[:, None] * invariant})

    def recentered(self, state: Tensor) -> Tensor:
        """Shift states ``[*B, N, 13]`` so that the bodies' mean position is 0 along invariant axes.

        The world stays at 0, so that it does not reveal the absolute position.
        """
        if not self.recenters:
            return state
        position = self.layout.slices["position"]
        weight = (self.predicted / self.predicted.sum()).to(state.dtype)
        center = (state[..., position] * weight[:, None]).sum(-2, keepdim=True)
        moved = state[..., position] - center * self.shifted.to(state.dtype)
        return torch.cat((state[..., : position.start], moved, state[..., position.stop :]), dim=-1)

    def forward(self, state: Tensor, parameters: PhysicalParameters) -> CanonicalState:
        """Compute the canonical state of ``[*B, N, 13]``: recentre, then rotate to yaw 0.

        The world node keeps its frame, unless contacts depend on the yaw: then it rotates with the scene and shows the
        yaw.
        """
        state, rotation = self.recentered(state), self.yaw_rotation(state, parameters)
        if self.yaw_frame is not None and rotation is not None:
            pivot = pad(parameters.pivot.to(state.dtype), (0, self.layout.size - 3)).unsqueeze(-2)
            back = quaternion.conjugate(rotation.quaternion)
            rotated = self.layout.rotate(state - pivot, back, rotation.matrix.mT) + pivot
            state = torch.cat((state[..., :1, :], rotated[..., 1:, :]), dim=-2) if self.yaw_frame.exact else rotated
        return CanonicalState(state, self.matrices(state), rotation)

    def matrices(self, state: Tensor) -> Tensor | None:
        """Return rotation matrices ``[*B, N, 3, 3]`` of a state's orientations; None if it has none."""
        where = self.layout.slices.get("orientation")
        return None if where is None else quaternion.to_matrix(state[..., where]).unflatten(-1, (3, 3))

    def yaw_rotation(self, state: Tensor, parameters: PhysicalParameters) -> FrameRotation | None:
        """Return the rotation from the yaw frame to the world; None without a yaw frame."""
        if self.yaw_frame is None:
            return None
        orientation = state[..., self.yaw_frame.node, self.layout.slices["orientation"]]
        relative = quaternion.product(orientation, quaternion.conjugate(parameters.rest.to(state.dtype)))
        twist = relative
        if self.yaw_frame.axis is not None:  # the twist about the axis, by swing-twist decomposition
            twist_mask = torch.zeros(4, dtype=state.dtype, device=state.device)
            twist_mask[0] = twist_mask[1 + self.yaw_frame.axis] = 1
            twist = relative * twist_mask
        if self.tilts:
            upside_down = twist.square().sum(-1, keepdim=True) < _UPSIDE_DOWN**2
            identity = torch.eye(4, dtype=state.dtype, device=state.device)[0]
            twist = torch.where(upside_down, identity, twist)
        twist = quaternion.normalize(twist)
        return FrameRotation(twist, quaternion.to_matrix(twist).unflatten(-1, (3, 3)))
