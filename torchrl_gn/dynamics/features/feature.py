"""Input features of a forward model's network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, ClassVar, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_gn.maths.state_layout import StateLayout
from torchrl_gn.scenes import Articulation, Scene, require_bodies

if TYPE_CHECKING:
    from torchrl_gn.dynamics.features.canonical_state import BoundCanonicalizer, CanonicalState
    from torchrl_gn.scenes.physical_parameters import PhysicalParameters


CLIPPED_SCALE = 0.1  # least standard deviation of a number clipped to 1, or of a velocity (m/s) that fades to 0


class StepInputs(NamedTuple):
    """Inputs of a feature."""

    canonical: CanonicalState  # the canonical state
    controls: Tensor  # [*B, E, C] mean controls of the step at each edge, clipped to the actuators' limits
    parameters: PhysicalParameters  # physical parameters of the scene, or of each sample
    action: Tensor | None = None  # [*B, A] of the present step, within its bounds
    ends: tuple[Tensor, Tensor] | None = None  # controls at the step's start and end, with delays; None: equal


@dataclass(frozen=True)
class Feature:
    """Features of every node or edge (base class).

    A feature holds options; the module that :meth:`bind` returns holds constants of a scene.
    """

    part: ClassVar[Literal["nodes", "edges"]]  # part of the graph that gets the features
    adds_edges: ClassVar[bool] = False  # True if it adds edges after the scene's

    @staticmethod
    def suits(scene: object) -> bool:
        """Return True if the feature is informative about a scene; by default, models use it only then."""
        return True

    def resolved(self, scene: Articulation) -> Feature:
        """Return the feature with its unset options read from a scene."""
        return self

    def size(self, layout: StateLayout) -> int:
        """Return the number of features of each node or edge."""
        raise NotImplementedError

    def least_scales(self, layout: StateLayout) -> list[float]:
        """Return lower bounds on the numbers' standard deviations, for numbers that hardly vary in data; 0: none."""
        return [0.0] * self.size(layout)

    def added_edges(self, scene: Articulation) -> np.ndarray:
        """Return senders and receivers ``[2, X]`` of the edges that the feature adds."""
        return np.empty((2, 0), dtype=np.int64)

    def bind(self, scene: Articulation, layout: StateLayout, canonicalizer: BoundCanonicalizer) -> nn.Module:
        """Return the module from :class:`StepInputs` to features ``[*B, N, size]`` or ``[*B, E, size]`` of one scene.

        It may return the features of the first edges only; the other edges then get zeros.
        """
        raise NotImplementedError

    def require_bodies(self, scene: Articulation) -> Scene:
        """Return a scene with bodies; TypeError for a kinematic tree."""
        return require_bodies(scene, f"Feature {type(self).__name__}")

    def options(self) -> dict:
        """Return the options as plain values."""
        return asdict(self)


def graph_edges(scene: Articulation, features: Sequence[Feature]) -> Tensor:
    """Return senders and receivers ``[2, E]`` of the network's graph: the scene's edges, then added ones."""
    added = [feature.added_edges(scene) for feature in features]
    return torch.as_tensor(np.concatenate((np.stack((scene.senders, scene.receivers)), *added), axis=1)).long()
