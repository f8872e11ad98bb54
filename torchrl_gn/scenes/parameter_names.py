"""Names of physical parameters: they find a column wherever it stands."""

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
    """Names of the physical-parameter columns of a scene, a data set or a model.

    Matching by name lets data sets and weights outlive changes of the columns.
    """

    nodes: tuple[str, ...] = ()
    edges: tuple[str, ...] = ()
    globals_: tuple[str, ...] = ()

    @classmethod
    def of(cls, scene: Scene) -> ParameterNames:
        """Names of a scene."""
        static = scene.static
        return cls(tuple(static.node_names), tuple(static.edge_names), tuple(static.global_names))

    @classmethod
    def from_names(cls, names: Mapping[str, Sequence[str]]) -> ParameterNames:
        """Restore from ``dataclasses.asdict``, also after JSON."""
        return cls(**{part: tuple(columns) for part, columns in names.items()})

    def common(self, other: ParameterNames) -> ParameterNames:
        """Names that ``other`` has too, in the order of this set."""
        others = asdict(other)
        return ParameterNames(
            **{part: tuple(name for name in names if name in others[part]) for part, names in asdict(self).items()}
        )

    def missing_in(self, other: ParameterNames) -> list[str]:
        """List the names that ``other`` lacks, ignoring types and flags of another MuJoCo version."""
        others = asdict(other)
        return [
            name
            for part, names in asdict(self).items()
            for name in names
            if name not in others[part] and not is_member(name)
        ]

    def columns_in(self, other: ParameterNames) -> dict[str, list[int]]:
        """Each name's column in ``other``, by part, for :func:`take_columns`; -1 where missing."""
        columns = {part: {name: column for column, name in enumerate(names)} for part, names in asdict(other).items()}
        return {part: [columns[part].get(name, -1) for name in names] for part, names in asdict(self).items()}

    def select(self, scene: Scene) -> PhysicalParameters:
        """A scene's physical parameters with these columns alone; ValueError if it lacks one.

        Types and flags that this MuJoCo version does not know are 0.
        """
        values, available = PhysicalParameters.of(scene), ParameterNames.of(scene)
        if missing := self.missing_in(available):
            raise ValueError(f"Scene {scene.name!r} lacks the static features {missing} that the model reads.")
        columns = self.columns_in(available)
        return values._replace(**{part: take_columns(getattr(values, part), columns[part]) for part in columns})


def take_columns(values: Tensor, columns: Sequence[int] | Tensor) -> Tensor:
    """Select columns of ``[..., F]``; column -1 gives zeros."""
    return pad(values, (0, 1))[..., torch.as_tensor(columns, dtype=torch.long)]
