"""Input features of a forward model's network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, ClassVar, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_gn.maths.state_layout import StateLayout

if TYPE_CHECKING:
    from torchrl_gn.dynamics.features.canonical_state import BoundCanonicalizer, CanonicalState
    from torchrl_gn.scenes import Scene
    from torchrl_gn.scenes.physical_parameters import PhysicalParameters


CLIPPED_SCALE = 0.1  # least standard deviation of a number clipped to 1, as of a velocity (m/s) that fades to 0


class StepInputs(NamedTuple):
    """What features are computed from."""

    canonical: CanonicalState  # the canonical state
    controls: Tensor  # [*B, E, C] controls at each edge's joint, clipped to the actuators' limits, means of the step
    parameters: PhysicalParameters  # physical parameters of the scene, or of each sample
    action: Tensor | None = None  # [*B, A] of the present step, within its bounds
    ends: tuple[Tensor, Tensor] | None = None  # controls at the step's start and end, as delays have them; None: equal


@dataclass(frozen=True)
class Feature:
    """Features of every node or edge (base class): options here, constants of a scene in what :meth:`bind` returns."""

    part: ClassVar[Literal["nodes", "edges"]]  # whether nodes or edges get the features
    adds_edges: ClassVar[bool] = False  # whether it adds edges behind the scene's

    @staticmethod
    def suits(scene: object) -> bool:
        """Whether it tells something of a scene: models show it of themselves only if it does."""
        return True

    def resolved(self, scene: Scene) -> Feature:
        """The same feature with its open options read from a scene."""
        return self

    def size(self, layout: StateLayout) -> int:
        """Number of features of each node or edge."""
        raise NotImplementedError

    def least_scales(self, layout: StateLayout) -> list[float]:
        """Least standard deviation of each number, for those that hardly vary in data; 0: that of the data."""
        return [0.0] * self.size(layout)

    def added_edges(self, scene: Scene) -> np.ndarray:
        """Senders above receivers ``[2, X]`` of the edges that it adds."""
        return np.empty((2, 0), dtype=np.int64)

    def bind(self, scene: Scene, layout: StateLayout, canonicalizer: BoundCanonicalizer) -> nn.Module:
        """Module from :class:`StepInputs` to features ``[*B, N, size]`` or ``[*B, E, size]``, for one scene.

        Edges behind the last that it gives features to have 0.
        """
        raise NotImplementedError

    def require_bodies(self, scene: Scene, layout: StateLayout) -> None:
        """Raise ValueError unless states are those of bodies."""
        if "orientation" not in layout.names:
            raise ValueError(
                f"{type(self).__name__} needs states of bodies; scene {scene.name!r} has others: leave the feature out."
            )

    def options(self) -> dict:
        """Its options as plain values."""
        return asdict(self)


def graph_edges(scene: Scene, features: Sequence[Feature]) -> Tensor:
    """Senders above receivers ``[2, E]`` of the graph that the network sees: the scene's edges, then added ones."""
    added = [feature.added_edges(scene) for feature in features]
    return torch.as_tensor(np.concatenate((np.stack((scene.senders, scene.receivers)), *added), axis=1)).long()
