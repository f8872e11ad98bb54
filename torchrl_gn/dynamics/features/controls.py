"""The controls as features of the edges where they act."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_gn.dynamics.features.feature import Feature, StepInputs
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.state_layout import StateLayout

if TYPE_CHECKING:
    from torchrl_gn.dynamics.features.canonical_state import BoundCanonicalizer
    from torchrl_gn.scenes import Articulation

_SLACK = 1e-6  # relative to the larger bound


@dataclass(frozen=True)
class Controls(Feature):
    """Controls that act at each edge."""

    part: ClassVar[Literal["nodes", "edges"]] = "edges"

    per_joint: int | None = None  # maximum number of controls at one edge; None: the scene's

    def resolved(self, scene: Articulation) -> Controls:
        return self if self.per_joint is not None else replace(self, per_joint=controls_per_edge(scene))

    def size(self, layout: StateLayout) -> int:
        return 1 if self.per_joint is None else self.per_joint

    def bind(self, scene: Articulation, layout: StateLayout, canonicalizer: BoundCanonicalizer) -> nn.Module:
        require_slots(scene, self.size(layout), "controls at each edge")
        return _Bound()


class _Bound(nn.Module):
    def forward(self, inputs: StepInputs) -> Tensor:
        return inputs.controls


def controls_per_edge(scene: Articulation) -> int:
    """Return the maximum number ``C`` of controls at one edge of a scene, at least 1."""
    return int(scene.edge_action.shape[1])


def require_slots(scene: Articulation, count: int, what: str) -> None:
    """Raise ValueError unless a scene has ``count`` control slots at each edge; ``what`` names them in the message."""
    if (slots := controls_per_edge(scene)) != count:
        raise ValueError(
            f"The model reads {count} {what}, scene {scene.name!r} has {slots}: build the model with"
            " ForwardModel.for_scene."
        )


class ControlInputs(Float64Buffers):
    """Map from a scene's actions to controls at the edges where they act."""

    action_low: Tensor
    action_high: Tensor
    edge_action: Tensor

    def __init__(self, scene: Articulation) -> None:
        super().__init__()
        self.present = getattr(scene, "present", scene).num_actions  # present commands; past ones follow them
        edge_action = torch.as_tensor(scene.edge_action).long()
        # Rounding to single precision may put actions beyond their bounds, where a planner still needs the gradient.
        bounds = np.stack((scene.action_low, scene.action_high))
        slack = _SLACK * np.abs(np.where(np.isfinite(bounds), bounds, 0.0)).max(0)
        values = {
            "action_low": torch.as_tensor(scene.action_low - slack),
            "action_high": torch.as_tensor(scene.action_high + slack),
            # Edges without actuator read a column of zeros that is appended to the actions.
            "edge_action": torch.where(edge_action < 0, scene.num_actions, edge_action),
        }
        self.constants(values)

    def forward(self, action: Tensor) -> Tensor:
        """Return controls ``[*B, E, C]`` of actions ``[*B, A]``, clipped to the actuators' limits as in MuJoCo."""
        return self.at_edges(self.clipped(action))

    def at_edges(self, action: Tensor) -> Tensor:
        """Return controls ``[*B, E, C]`` of actions ``[*B, A]`` that are within the limits."""
        padded = torch.cat((action, action.new_zeros((*action.shape[:-1], 1))), dim=-1)
        return padded[..., self.edge_action]

    def commands(self, action: Tensor) -> Tensor:
        """Return the present commands of actions ``[*B, A]`` that known physics read, clipped to their limits."""
        return self.clipped(action)[..., : self.present]

    def clipped(self, action: Tensor) -> Tensor:
        """Clip actions ``[*B, A]`` to the actuators' limits."""
        # Adding 0 * action makes an infinite action NaN instead of the limit.
        return action.clamp(self.action_low.to(action.dtype), self.action_high.to(action.dtype)) + 0 * action
