"""Names of static features: what a column means, whatever its place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchrl_gn.scenes.physical_parameters import PhysicalParameters
from torchrl_gn.scenes.static_features import is_member

if TYPE_CHECKING:
    from torchrl_gn.scenes.scene import Scene


@dataclass(frozen=True)
class ParameterNames:
    """Names of static features, column by column: of a scene, of a data set, or those that a model reads.

    Columns are found by these names alone, so that a version of the library with more static features, or in another
    order, reads data sets and weights of before.

    Attributes:
        nodes: names of the static node features.
        edges: names of the static edge features.
        globals_: names of the static global features.
    """

    nodes: tuple[str, ...] = ()
    edges: tuple[str, ...] = ()
    globals_: tuple[str, ...] = ()

    @classmethod
    def of(cls, scene: Scene) -> ParameterNames:
        """The static features that a scene has."""
        static = scene.static
        return cls(tuple(static.node_names), tuple(static.edge_names), tuple(static.global_names))

    @classmethod
    def from_names(cls, names: Mapping[str, Sequence[str]]) -> ParameterNames:
        """From what ``dataclasses.asdict`` gave, perhaps through JSON."""
        return cls(**{part: tuple(of_part) for part, of_part in names.items()})

    def common(self, other: ParameterNames) -> ParameterNames:
        """Those that another set has too, in the order of this one."""
        others = asdict(other)
        return ParameterNames(
            **{part: tuple(name for name in names if name in others[part]) for part, names in asdict(self).items()}
        )

    def missing_in(self, other: ParameterNames) -> list[str]:
        """Those that another set lacks, but for types and flags of another version of MuJoCo."""
        others = asdict(other)
        return [
            name
            for part, names in asdict(self).items()
            for name in names
            if name not in others[part] and not is_member(name)
        ]

    def columns_in(self, other: ParameterNames) -> dict[str, list[int]]:
        """Column in another set of each of these, by part, for :func:`take_columns`; -1 where it is missing."""
        places = {part: {name: place for place, name in enumerate(names)} for part, names in asdict(other).items()}
        return {part: [places[part].get(name, -1) for name in names] for part, names in asdict(self).items()}

    def select(self, scene: Scene) -> PhysicalParameters:
        """The numbers of a scene, of its static features only these.

        A type or flag that this version of MuJoCo does not know is 0: no scene has it here.

        Raises:
            ValueError: if the scene lacks one.
        """
        values, there = PhysicalParameters.of(scene), ParameterNames.of(scene)
        if missing := self.missing_in(there):
            raise ValueError(f"Scene {scene.name!r} lacks the static features {missing} that the model reads.")
        columns = self.columns_in(there)
        return values._replace(**{part: take_columns(getattr(values, part), columns[part]) for part in columns})


def take_columns(values: Tensor, columns: Sequence[int] | Tensor) -> Tensor:
    """Columns of ``[..., F]``; zeros for column -1."""
    return pad(values, (0, 1))[..., torch.as_tensor(columns, dtype=torch.long)]
