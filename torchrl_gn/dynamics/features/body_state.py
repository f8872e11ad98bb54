"""The canonical state of each body as node features."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal, get_args

import torch
from torch import Tensor, nn

from torchrl_gn.dynamics.features.feature import Feature, StepInputs
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.state_layout import Encoding, StateLayout

if TYPE_CHECKING:
    from torchrl_gn.dynamics.features.canonical_state import BoundCanonicalizer
    from torchrl_gn.scenes import Articulation


@dataclass(frozen=True)
class BodyState(Feature):
    """Encoded canonical state of each body, without the activations and other scalars that it holds."""

    part: ClassVar[Literal["nodes", "edges"]] = "nodes"

    encoding: Encoding = "matrix"  # of orientations; paper: "quaternion"
    # Show positions along axes of translation invariance. Without them, a network transfers to larger scenes than
    # those of training.
    positions: bool = True

    def __post_init__(self) -> None:
        if self.encoding not in get_args(Encoding):
            raise ValueError(f"encoding={self.encoding!r} is not known; use one of {list(get_args(Encoding))}.")

    def size(self, layout: StateLayout) -> int:
        return layout.spatial.encoded_size(self.encoding)

    def bind(self, scene: Articulation, layout: StateLayout, canonicalizer: BoundCanonicalizer) -> nn.Module:
        return _Bound(self, scene, layout, canonicalizer)


class _Bound(Float64Buffers):
    visible: Tensor

    def __init__(
        self, options: BodyState, scene: Articulation, layout: StateLayout, canonicalizer: BoundCanonicalizer
    ) -> None:
        super().__init__()
        self.layout, self.channels = layout.spatial, layout.spatial.size
        self.encoding: Encoding = options.encoding
        invariant = torch.as_tensor(scene.translation_invariant)
        # With a yaw frame, both axes across the yaw axis must be invariant, to be hidden at every yaw.
        yaw = canonicalizer.yaw_frame
        across = invariant
        if yaw is not None:
            across = torch.ones(3, dtype=torch.bool) if yaw.axis is None else torch.arange(3) != yaw.axis
        self.hides = bool(not options.positions and invariant.any() and invariant[across].all())
        if self.hides:
            visible = torch.ones(scene.num_nodes, self.channels)
            visible[:, layout.slices["position"]] -= canonicalizer.shifted
            self.constants({"visible": visible})

    def forward(self, inputs: StepInputs) -> Tensor:
        state, matrices = inputs.canonical[:2]
        state = state[..., : self.channels]
        visible_state = state * self.visible.to(state.dtype) if self.hides else state
        return self.layout.encode(visible_state, self.encoding, matrices)
