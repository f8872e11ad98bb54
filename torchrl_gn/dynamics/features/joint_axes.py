"""Joint axes as features of their edges."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal

import torch
from torch import Tensor, nn

from torchrl_gn.dynamics.features.controls import controls_per_edge, require_slots
from torchrl_gn.dynamics.features.feature import Feature, StepInputs
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.state_layout import StateLayout
from torchrl_gn.scenes.physical_parameters import joint_axes

if TYPE_CHECKING:
    from torchrl_gn.dynamics.features.canonical_state import BoundCanonicalizer
    from torchrl_gn.scenes import Articulation, Scene


@dataclass(frozen=True)
class JointAxes(Feature):
    """Each joint's axis in the canonical frame, and the axis times each control.

    The network need not learn to rotate them. Paper: the network sees the control alone.
    """

    part: ClassVar[Literal["nodes", "edges"]] = "edges"

    per_joint: int = 1  # maximum number of controls at one edge

    def resolved(self, scene: Articulation) -> JointAxes:
        return replace(self, per_joint=controls_per_edge(scene))

    def size(self, layout: StateLayout) -> int:
        return 3 + 3 * self.per_joint

    def bind(self, scene: Articulation, layout: StateLayout, canonicalizer: BoundCanonicalizer) -> nn.Module:
        scene = self.require_bodies(scene)
        require_slots(scene, self.per_joint, "controls along each axis")
        return _Bound(scene)


class _Bound(Float64Buffers):
    joint_node: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        self.constants({"joint_node": torch.as_tensor(joint_axes(scene)[0]).long().repeat_interleave(2)})

    def forward(self, inputs: StepInputs) -> Tensor:
        matrices = inputs.canonical.matrices
        assert matrices is not None
        axis = inputs.parameters.joint_axis.to(matrices.dtype).unsqueeze(-1)
        axes = (matrices[..., self.joint_node, :, :] @ axis).squeeze(-1)
        along = [control * axes for control in inputs.controls.split(1, dim=-1)]
        return torch.cat((axes, *along), dim=-1)
