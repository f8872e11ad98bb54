"""The physical parameters that a predictor reads."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey

from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.scenes.physical_parameters import ParameterNames, PhysicalParameters, take_columns

if TYPE_CHECKING:
    from torchrl_gn.dynamics.model import ForwardModel
    from torchrl_gn.scenes import Articulation

_PARTS = ("nodes", "edges", "globals_")
_ANCHORS = ("parent_anchor", "child_anchor")


class ParameterReader(Float64Buffers):
    """Reader of a predictor's physical parameters: the scene's, the samples', or inferred ones.

    With ``project`` it also reads joint anchors, for the constraint projection. ``key`` and ``brought`` are the
    ``parameters_key`` and ``parameter_names`` of the predictor. Raises ValueError if samples lack parameters that the
    model reads.
    """

    def __init__(
        self,
        model: ForwardModel,
        scene: Articulation,
        key: NestedKey | None,
        *,
        project: bool,
        brought: ParameterNames | None = None,
    ) -> None:
        super().__init__()
        self.source, self.key, self.scene = model.parameter_source, key, scene
        self.inferred = (*_PARTS, *_ANCHORS) if project else _PARTS
        self.constants(model.parameters_of(scene)._asdict())
        reads = model.parameter_names
        everything = ParameterNames.of(scene) if brought is None else brought
        self.brought = everything if self.source == "scene" else reads
        if missing := reads.missing_in(self.brought):
            raise ValueError(
                f"The model reads the parameters {missing}, which samples of {scene.name!r} lack. Collect them"
                " anew, or build the model with the parameters of their data set."
            )
        # Where both have the same columns, nothing is gathered.
        self.columns = None if reads == self.brought else tuple(f"{part}_columns" for part in _PARTS)
        if self.columns is not None:
            columns = (torch.tensor(of_part, dtype=torch.long) for of_part in reads.columns_in(self.brought).values())
            self.constants(dict(zip(self.columns, columns, strict=True)))

    @property
    def own(self) -> PhysicalParameters:
        """The scene's own physical parameters, without batch."""
        return PhysicalParameters(*(getattr(self, name) for name in PhysicalParameters._fields))

    def entries(self) -> TensorDict:
        """Return the entry, without batch, of a sample that has the scene's parameters; zeros for an inferred graph."""
        if self.source == "inferred":
            return self.own.tensordict().select(*self.inferred)
        return self._brought_by(self.scene).tensordict().to(self.own.nodes.device)

    def of(self, scene: Articulation, values: PhysicalParameters) -> TensorDict:
        """Return the entry, without batch, of a variant's sample; ``values`` if the model reads no true parameters."""
        brought = self._brought_by(scene) if self.source == "scene" else values
        return brought.tensordict().to(self.own.nodes.device)

    def _brought_by(self, scene: Articulation) -> PhysicalParameters:
        if scene is self.scene and self.columns is None:
            return self.own
        return self.brought.select(scene)

    def read(self, parameters: TensorDictBase | None) -> PhysicalParameters:
        """Return the parameters of the samples, or else the scene's own; ValueError if they do not suit the model."""
        if parameters is None:
            return self.own
        if self.source == "inferred":
            entries, expected = set(map(str, parameters.keys())), set(self.inferred)
            if entries - expected:
                raise ValueError(
                    f"The model reads an inferred static graph; {sorted(entries - expected)} are true"
                    " parameters, which it must not see. Give the output of an inference model."
                )
            if not set(_ANCHORS) & expected <= entries:
                raise ValueError(
                    "The model projects onto joint anchors that an inference model estimates;"
                    f" {sorted(expected - entries)} are missing. Give the output of this model's own inference model."
                )
        return PhysicalParameters.read(self._selected(parameters), self.own)

    def _selected(self, parameters: TensorDictBase) -> TensorDictBase:
        if self.source != "scene":
            return parameters
        selected = parameters
        for index, part in enumerate(_PARTS):
            values, names = parameters.get(part, None), getattr(self.brought, part)
            if values is None:
                continue
            if values.shape[-1] != len(names):
                raise ValueError(
                    f"Samples have {values.shape[-1]} static features in {part!r}, not the {len(names)} of scene"
                    f" {self.scene.name!r}. If their data set has others, give their names:"
                    " bind(..., parameter_names=dataset.features)."
                )
            if self.columns is not None:
                selected = parameters.copy() if selected is parameters else selected
                selected.set(part, take_columns(values, getattr(self, self.columns[index])))
        return selected

    def find(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        """Return the samples' own physical parameters, see :meth:`Predictor.parameters_in`."""
        parameters = tensordict.get("parameters" if self.key is None else self.key, None)
        if self.key is not None:
            if self.source == "none":
                return None
            if parameters is None:
                raise KeyError(
                    f"The model reads each sample's physical parameters at {self.key!r}; give parameters_of(scene),"
                    " or bind without parameters_key."
                )
            return parameters
        if name := _other_than(self._brought_by(self.scene), self.scene, parameters):
            raise ValueError(
                f"Samples have other parameters {name!r} than scene {self.scene.name!r}, which the model is bound to."
                " Bind it with parameters_key='parameters' to predict variants of the scene."
            )
        return None


def refuse_variants(scene: Articulation, trajectories: TensorDictBase) -> None:
    """Raise ValueError if trajectories have, at ``parameters``, other physical parameters than the scene's."""
    if name := _other_than(PhysicalParameters.of(scene), scene, trajectories.get("parameters", None)):
        raise ValueError(
            f"Trajectories have other parameters {name!r} than scene {scene.name!r}; give both of one scene."
        )


def _other_than(values: PhysicalParameters, scene: Articulation, parameters: object) -> str | None:
    """Return the name of a parameter of samples that differs from a scene's ``values``, None if there is none."""
    if not isinstance(parameters, TensorDictBase):
        return None
    for name, scene_value in values._asdict().items():
        value = parameters.get(name, None)
        if value is None:
            continue
        scene_value = scene_value.to(value.device)
        if value.shape[-1] != scene_value.shape[-1]:  # all features of a scene, not only those that the model reads
            scene_value = getattr(PhysicalParameters.of(scene), name).to(value.device)
        alike = value.shape[-1] == scene_value.shape[-1]
        if not (alike and bool((value - scene_value).abs().le(1e-6 * scene_value.abs() + 1e-12).all())):
            return name
    return None
