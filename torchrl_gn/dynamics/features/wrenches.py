"""Forces and torques of actuators at sites as features of their edges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_gn.dynamics.features.feature import Feature, StepInputs
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.state_layout import StateLayout
from torchrl_gn.scenes import Articulation, Scene
from torchrl_gn.scenes.actuator_kinds import switched_off
from torchrl_gn.scenes.topology import topology
from torchrl_gn.scenes.transmissions import Transmissions, find_transmissions

if TYPE_CHECKING:
    from torchrl_gn.dynamics.features.canonical_state import BoundCanonicalizer


@dataclass(frozen=True)
class Wrenches(Feature):
    """Force and torque about the node, times the control, summed over actuators at sites, in the canonical frame.

    The network need not learn to rotate them with the body, for example with a drone and its rotors.
    """

    part: ClassVar[Literal["nodes", "edges"]] = "edges"

    @staticmethod
    def suits(scene: object) -> bool:
        """Return True if a scene has actuators at sites."""
        return isinstance(scene, Scene) and bool((_transmissions(scene).frame >= 0).any())

    def size(self, layout: StateLayout) -> int:
        return 6

    def bind(self, scene: Articulation, layout: StateLayout, canonicalizer: BoundCanonicalizer) -> nn.Module:
        scene = self.require_bodies(scene)
        return _Bound(scene)


class _Bound(Float64Buffers):
    frame: Tensor
    wrench: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        acting = _transmissions(scene)
        acts = (acting.frame >= 0) & ~np.isin(acting.action, np.flatnonzero(switched_off(scene.model)))
        wrench = np.where(acts[..., None], acting.gear, 0.0).reshape(*acting.frame.shape, 2, 3)
        values = {
            "frame": torch.as_tensor(np.maximum(acting.frame, 0)).repeat_interleave(2, 0),  # [E, C]
            "wrench": torch.as_tensor(wrench).repeat_interleave(2, 0),  # [E, C, 2, 3] force, torque
        }
        self.constants(values)

    def forward(self, inputs: StepInputs) -> Tensor:
        matrices = inputs.canonical.matrices
        assert matrices is not None
        exerted = []
        for slot, control in enumerate(inputs.controls.split(1, dim=-1)):
            rotation = matrices[..., self.frame[:, slot], :, :]
            wrench = self.wrench[:, slot].to(matrices.dtype).unsqueeze(-1)  # [E, 2, 3, 1]
            both = [(rotation @ part).squeeze(-1) for part in wrench.unbind(1)]
            exerted.append(control * torch.cat(both, dim=-1))
        return sum(exerted[1:], exerted[0])


def _transmissions(scene: Scene) -> Transmissions:
    return find_transmissions(scene.model, topology(scene.model))
