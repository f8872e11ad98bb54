"""The change that known physics predict, as node features."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

from torch import Tensor, nn

from torchrl_gn.dynamics.features.feature import Feature, StepInputs
from torchrl_gn.maths.state_layout import StateLayout

if TYPE_CHECKING:
    from torchrl_gn.dynamics.features.canonical_state import BoundCanonicalizer
    from torchrl_gn.scenes import Articulation


@dataclass(frozen=True)
class PhysicsChange(Feature):
    """Each body's change in the canonical frame, predicted by the model's physics; part of all models with physics."""

    part: ClassVar[Literal["nodes", "edges"]] = "nodes"

    def size(self, layout: StateLayout) -> int:
        return layout.delta_size

    def bind(self, scene: Articulation, layout: StateLayout, canonicalizer: BoundCanonicalizer) -> nn.Module:
        return _Bound()


class _Bound(nn.Module):
    def forward(self, inputs: StepInputs) -> Tensor:
        assert inputs.canonical.change is not None
        return inputs.canonical.change
