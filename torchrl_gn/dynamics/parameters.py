"""The numbers that a model reads of its scene, and of samples that bring their own."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey

from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.scenes.parameter_names import ParameterNames, take_columns
from torchrl_gn.scenes.physical_parameters import PhysicalParameters

if TYPE_CHECKING:
    from torchrl_gn.scenes import Scene

_PARTS = ("nodes", "edges", "globals_")
_PINS = ("parent_anchor", "child_anchor")


class ParameterReader(Float64Buffers):
    """What a bound model reads of lengths, masses, ...: its scene's, its samples', or what was inferred of them.

    Args:
        own: the scene's, as the model reads them.
        kind: the model's option ``parameters``: ``"scene"``, ``"none"`` or ``"inferred"``.
        key: where samples bring their own; None: they are the scene's.
        linked: whether the model links bodies, for which it needs their joint anchors.
        scene: the scene.
        reads: names of the static features that the model reads.
        brought: names of those that samples bring; None: all that the scene has.

    Raises:
        ValueError: if samples do not bring what the model reads.
    """

    def __init__(
        self,
        own: PhysicalParameters,
        kind: str,
        key: NestedKey | None,
        *,
        linked: bool,
        scene: Scene,
        reads: ParameterNames,
        brought: ParameterNames | None = None,
    ) -> None:
        super().__init__()
        self.kind, self.key, self.scene = kind, key, scene
        self.inferred = (*_PARTS, *_PINS) if linked else _PARTS
        self.constants(own._asdict())
        self.brought = (ParameterNames.of(scene) if brought is None else brought) if kind == "scene" else reads
        if missing := reads.missing_in(self.brought):
            raise ValueError(
                f"The model reads the static features {missing}, which samples of {scene.name!r} do not bring. Collect"
                " them anew, or build the model with the features of their data set."
            )
        # Where both have the same columns, nothing is gathered.
        self.columns = None if reads == self.brought else tuple(f"{part}_columns" for part in _PARTS)
        if self.columns is not None:
            columns = (torch.tensor(of_part, dtype=torch.long) for of_part in reads.columns_in(self.brought).values())
            self.constants(dict(zip(self.columns, columns, strict=True)))

    @property
    def own(self) -> PhysicalParameters:
        """The scene's own, without batch."""
        return PhysicalParameters(*(getattr(self, name) for name in PhysicalParameters._fields))

    def entries(self) -> TensorDict:
        """What a sample of the scene itself brings, without batch; zeros of an inferred graph."""
        if self.kind == "inferred":
            return self.own.tensordict().select(*self.inferred)
        return self._brought_by(self.scene).tensordict().to(self.own.nodes.device)

    def of(self, scene: Scene, values: PhysicalParameters) -> TensorDict:
        """What a sample of a variant brings, without batch; zeros, the model's ``values``, of an inferred graph."""
        brought = self._brought_by(scene) if self.kind == "scene" else values
        return brought.tensordict().to(self.own.nodes.device)

    def _brought_by(self, scene: Scene) -> PhysicalParameters:
        if scene is self.scene and self.columns is None:
            return self.own
        return self.brought.select(scene)

    def read(self, parameters: TensorDictBase | None) -> PhysicalParameters:
        """Numbers that samples bring, or the scene's own.

        Raises:
            ValueError: if the model infers its static graph and they are true parameters, or joint anchors are missing.
        """
        if parameters is None:
            return self.own
        if self.kind == "inferred":
            given, wanted = set(map(str, parameters.keys())), set(self.inferred)
            if given - wanted:
                raise ValueError(
                    f"The model reads an inferred static graph; {sorted(given - wanted)} are true"
                    " parameters, which it must not see. Give what an inference model wrote."
                )
            if not set(_PINS) & wanted <= given:
                raise ValueError(
                    f"The model links bodies where an inference model finds their joint anchors; {sorted(wanted - given)} are"
                    " missing. Give what this model's own inference model wrote."
                )
        return PhysicalParameters.read(self._selected(parameters), self.own)

    def _selected(self, parameters: TensorDictBase) -> TensorDictBase:
        """Of the static features that samples bring those that the model reads."""
        if self.kind != "scene":
            return parameters
        selected = parameters
        for index, part in enumerate(_PARTS):
            given, names = parameters.get(part, None), getattr(self.brought, part)
            if given is None:
                continue
            if given.shape[-1] != len(names):
                raise ValueError(
                    f"Samples have {given.shape[-1]} static features in {part!r}, not the {len(names)} of scene"
                    f" {self.scene.name!r}. Of a data set made with others give their names:"
                    " bind(..., static_features=dataset.features)."
                )
            if self.columns is not None:
                selected = parameters.copy() if selected is parameters else selected
                selected.set(part, take_columns(given, getattr(self, self.columns[index])))
        return selected

    def find(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        """The physical parameters that samples bring; None where they are the scene's own.

        Of a model that does not read the true physical parameters nothing of the samples' own scenes gets here.

        Raises:
            KeyError: if the model reads them and they are missing.
            ValueError: if the model does not read them and they are not its scene's.
        """
        parameters = tensordict.get("parameters" if self.key is None else self.key, None)
        if self.key is not None:
            if self.kind == "none":
                return None
            if parameters is None:
                raise KeyError(
                    f"The model reads each sample's physical parameters at {self.key!r}; give parameters_of(scene),"
                    " or bind without parameters_key."
                )
            return parameters
        if isinstance(parameters, TensorDictBase):
            self._refuse_others(parameters)
        return None

    def _refuse_others(self, parameters: TensorDictBase) -> None:
        for name, own in self._brought_by(self.scene)._asdict().items():
            given = parameters.get(name, None)
            if given is None:
                continue
            own = own.to(given.device)
            if given.shape[-1] != own.shape[-1]:  # all features of a scene, not only those that the model reads
                own = getattr(PhysicalParameters.of(self.scene), name).to(given.device)
            alike = given.shape[-1] == own.shape[-1]
            if alike and bool((given - own).abs().le(1e-6 * own.abs() + 1e-12).all()):
                continue
            raise ValueError(
                f"Samples have other static {name!r} than scene {self.scene.name!r}, which the model is bound to."
                " Bind it with parameters_key='parameters' to predict variants of the scene."
            )
