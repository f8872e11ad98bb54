"""Activations of actuators as features of the edges where they act."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchrl_gn.dynamics.features.controls import controls_per_edge, require_slots
from torchrl_gn.dynamics.features.feature import Feature, StepInputs
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.state_layout import StateLayout
from torchrl_gn.scenes import Articulation, Scene

if TYPE_CHECKING:
    from torchrl_gn.dynamics.features.canonical_state import BoundCanonicalizer


@dataclass(frozen=True)
class Activations(Feature):
    """Activations of filtered, integrating and muscle actuators, now and at the end of the step.

    Activations at the end follow from MuJoCo's laws; without a law, they equal the present ones.
    """

    part: ClassVar[Literal["nodes", "edges"]] = "edges"

    per_joint: int = 1  # maximum number of controls at one edge
    per_actuator: int = 1  # maximum number of activations of one actuator

    @staticmethod
    def suits(scene: object) -> bool:
        """Return True if a scene has activations."""
        return isinstance(scene, Scene) and scene.activations.size > 0

    def resolved(self, scene: Articulation) -> Activations:
        scene = self.require_bodies(scene)
        most = int(scene.model.actuator_actnum.max(initial=1))
        return replace(self, per_joint=controls_per_edge(scene), per_actuator=max(most, 1))

    def size(self, layout: StateLayout) -> int:
        return 2 * self.per_joint * self.per_actuator

    def bind(self, scene: Articulation, layout: StateLayout, canonicalizer: BoundCanonicalizer) -> nn.Module:
        scene = self.require_bodies(scene)
        require_slots(scene, self.per_joint, "actuators at each edge")
        return _Bound(scene, self.per_actuator)


class _Bound(Float64Buffers):
    place: Tensor

    def __init__(self, scene: Scene, most: int) -> None:
        super().__init__()
        model, none = scene.model, scene.model.na
        at = np.full((model.nu + 1, most), none)  # the last row stands for no actuator
        for actuator, (first, count) in enumerate(zip(model.actuator_actadr, model.actuator_actnum, strict=True)):
            at[actuator, :count] = np.arange(first, first + count)
        self.constants({"place": at[scene.edge_action]})

    def forward(self, inputs: StepInputs) -> Tensor:
        """Return features ``[*B, E, 2 C K]``, 0 for actuators without activation."""
        step = inputs.canonical.activations
        if step is None:  # only other scenes with the same weights have activations
            state = inputs.canonical.state
            return state.new_zeros((*state.shape[:-2], len(self.place), 2 * self.place[0].numel()))
        both = torch.stack([pad(each, (0, 1))[..., self.place] for each in (step.now, step.later)], dim=-1)
        return both.flatten(-3)
