"""Forward model: the weights that predict a control step of any scene."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any, Literal, cast, get_args

import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_gn.dynamics.bound import DYNAMIC_FLOOR, BoundPredictor, moving_parents
from torchrl_gn.dynamics.features import (
    FEATURES,
    Activations,
    Actuators,
    BodyState,
    Canonicalizer,
    Constraints,
    Contacts,
    Controls,
    Couplings,
    Feature,
    JointAxes,
    Joints,
    MocapPoses,
    PairContacts,
    PhysicsChange,
    Tendons,
    Wrenches,
    contacts_of,
    graph_edges,
    trees_can_touch,
)
from torchrl_gn.dynamics.mujoco_physics import physics_from_description
from torchrl_gn.dynamics.physics import as_physics
from torchrl_gn.maths.normalizer import Normalizer
from torchrl_gn.maths.state_layout import BODY_STATE, Component, StateLayout
from torchrl_gn.networks.core import Core
from torchrl_gn.networks.cores import core_class, require_options
from torchrl_gn.networks.graph import GraphSize
from torchrl_gn.scenes import Articulation, ParameterNames, PhysicalParameters, Scene
from torchrl_gn.scenes.load import as_scene

ParameterSource = Literal["none", "scene", "inferred"]

# Normalised physical parameters are clipped to this many standard deviations from training's mean.
_PARAMETER_LIMIT = 20.0


class ForwardModel(nn.Module):
    """Weights of a forward model: features, core and normalisers (paper, "Forward models", SM "Forward prediction").

    A model knows no scene: :meth:`bind` joins it to one and returns a :class:`~torchrl_gn.dynamics.BoundPredictor`. Any
    number of scenes share the same weights. :meth:`for_scene` reads the options that depend on a scene.

    A new model predicts no change, and no gradient reaches its weights, until its normalisers have seen data
    (:attr:`fitted`). :func:`~torchrl_gn.training.fit` fits them; a training loop of your own begins with
    :meth:`ForwardModelLoss.fit_normalizers <torchrl_gn.objectives.ForwardModelLoss.fit_normalizers>`.

    Args:
        parameter_names: physical parameters that the model reads, see :meth:`ParameterNames.of`.
        parameters: ``"scene"`` reads the true physical parameters, ``"none"`` reads none, ``"inferred"`` reads a graph
            from an inference model.
        inferred: numbers of node, edge and global features of the inferred graph. With ``project``, nodes get six more:
            the estimated anchor offsets less the scene's.
        layout: channels of the states.
        features: input features, with at least one of nodes and one of edges.
        canonicalizer: invariances that are built in; default: all.
        integrate: predict only the change of position and orientation that their rates do not explain (trapezoidal
            rule); the paper predicts the whole change. No effect with ``physics``.
        project: project predictions onto the joint constraints. Paper: bodies drift apart.
        parent_relative: predict two changes of each body, one absolute and one relative to its parent's change.
            Relative changes are added up along the tree, then added to the absolute ones. So the effect of a joint
            shows at that joint alone, not in the sum of all joints before it. Paper: the absolute change alone.
        least_scales: divide features that hardly varied in data by at least :meth:`Feature.least_scales`. False: only
            those of constraints and couplings.
        physics: known physics of one robot that the network corrects, a function or module of state and action; see
            :class:`~torchrl_gn.dynamics.physics.Physics`.
        core: name of the network, one of :data:`~torchrl_gn.networks.CORES`.
        counts: numbers of nodes and edges, for a core that reads graphs of one size.
        **core_options: options of the core's class, for example ``hidden=64``.

    Raises:
        TypeError: if ``parameter_names`` is something else, such as a scene, or an option does not exist.
        ValueError: if an option is not one of its choices, or features of nodes or of edges are missing.
    """

    def __init__(
        self,
        parameter_names: ParameterNames,
        *,
        parameters: ParameterSource = "scene",
        inferred: Sequence[int] = (10, 10, 10),
        layout: StateLayout = BODY_STATE,
        features: Sequence[Feature] = (BodyState(), Controls(), JointAxes(), Joints(), Contacts()),
        canonicalizer: Canonicalizer | None = None,
        integrate: bool = True,
        project: bool = True,
        parent_relative: bool = True,
        least_scales: bool = True,
        physics: Callable[[Tensor, Tensor], Tensor] | None = None,
        core: str = "gn",
        counts: Sequence[int] | None = None,
        **core_options,
    ) -> None:
        super().__init__()
        if not isinstance(parameter_names, ParameterNames):
            raise TypeError(
                f"parameter_names must be ParameterNames, got {type(parameter_names).__name__};"
                " for a scene use ForwardModel.for_scene(scene)."
            )
        if parameters not in (choices := list(get_args(ParameterSource))):
            raise ValueError(f"parameters={parameters!r} is not known; use one of {choices}.")
        self.parameter_source, self.layout, self.features = parameters, layout, tuple(features)
        self.physics = None if physics is None else as_physics(physics)
        if physics is not None and PhysicsChange() not in self.features:
            self.features += (PhysicsChange(),)
        self.parameter_names = parameter_names if parameters == "scene" else ParameterNames()
        self.canonicalizer = Canonicalizer() if canonicalizer is None else canonicalizer
        self.integrate, self.project, self.parent_relative = integrate, project, parent_relative
        self.least_scales = least_scales
        self.core_name, self.core_options = core, core_options

        self.dynamic_size = GraphSize(self._feature_count("nodes"), self._feature_count("edges"), 0)
        self.inferred_size = GraphSize(*inferred)
        names = self.parameter_names
        # One more static feature marks the edges that features add.
        self.marks_edges = any(feature.adds_edges for feature in self.features)
        static = GraphSize(len(names.nodes), len(names.edges), len(names.globals_))
        if parameters == "inferred":
            # The anchor offsets give the lengths of bodies.
            static = self.inferred_size + GraphSize(6 if project else 0, 0, 0)

        node_scales, edge_scales = self._least_scales("nodes"), self._least_scales("edges")
        self.node_normalizer = Normalizer(self.dynamic_size.nodes, floor=DYNAMIC_FLOOR, least=node_scales)
        self.edge_normalizer = Normalizer(self.dynamic_size.edges, floor=DYNAMIC_FLOOR, least=edge_scales)
        self.parameter_node_normalizer = Normalizer(static.nodes, limit=_PARAMETER_LIMIT)
        self.parameter_edge_normalizer = Normalizer(static.edges, limit=_PARAMETER_LIMIT)
        static += GraphSize(0, int(self.marks_edges), 0)
        self.parameter_global_normalizer = Normalizer(static.globals_, limit=_PARAMETER_LIMIT)
        # The network's output has the residual's scale; errors are weighted by the whole change's.
        self.residual_normalizer = Normalizer(layout.delta_size, floor=DYNAMIC_FLOOR)
        self.relative_normalizer = Normalizer(layout.delta_size, floor=DYNAMIC_FLOOR) if self.parent_relative else None
        self.delta_normalizer = Normalizer(layout.delta_size, floor=DYNAMIC_FLOOR)
        kind = cast(Any, core_class(core))
        require_options(kind, core_options)
        fixed = {"counts": counts} if kind.fixed_size else {}
        outputs = sum(normalizer.size for normalizer in self.output_normalizers)
        self.core: Core = kind(self.dynamic_size, static, outputs, **fixed, **core_options)
        if not hasattr(self.core, "hidden_size"):
            raise TypeError(f"{kind.__name__}.__init__ must call super().__init__(dynamic), as a Core does.")

    def _feature_count(self, part: str) -> int:
        """Return the number of features of each node or edge; ValueError if there are none."""
        sizes = [feature.size(self.layout) for feature in self.features if feature.part == part]
        if not sizes:
            raise ValueError(f"No feature is of {part}: the network needs some of nodes and some of edges.")
        return sum(sizes)

    def _least_scales(self, part: str) -> list[float]:
        """Return lower bounds on the standard deviations of the features of nodes or edges."""
        scales: list[float] = []
        for feature in self.features:
            bounded = self.least_scales or isinstance(feature, (Constraints, Couplings))
            if feature.part == part:
                scales += feature.least_scales(self.layout) if bounded else [0.0] * feature.size(self.layout)
        return scales

    @classmethod
    def for_scene(
        cls,
        scene: Articulation | str | os.PathLike | Sequence[Scene],
        *,
        features: Sequence[Feature] | None = None,
        **options,
    ) -> ForwardModel:
        """Build a model with fresh weights for one scene, or for several scenes that share the model.

        The first scene determines the layout, the controls at each joint, the names of the physical parameters and the
        size of the graph. ``parent_relative`` is switched off if no body has a moving parent; trees with a free joint
        do not count.

        Args:
            scene: the scene, its name or path, or several scenes.
            features: input features. Default: all that suit a scene, except :class:`Constraints` and
                :class:`Couplings`; :class:`PairContacts` only if bodies of different trees can touch.
            **options: options of :class:`ForwardModel` and its core.
        """
        scene_or_scenes = as_scene(scene)
        scenes = [scene_or_scenes] if isinstance(scene_or_scenes, Articulation) else list(scene_or_scenes)
        first = scenes[0]
        layout = first.layout
        if features is None:
            spatial = "orientation" in layout.names
            features = (BodyState(), Controls(), *((JointAxes(), Joints(), contacts_of(scenes)) if spatial else ()))
            optional = Actuators, Activations, Tendons, MocapPoses, Wrenches
            features += tuple(kind() for kind in optional if any(map(kind.suits, scenes)))
            features += (PairContacts(),) if spatial and any(map(trees_can_touch, scenes)) else ()
        chosen = [feature.resolved(first) for feature in features]
        counts = first.num_nodes, graph_edges(first, chosen).shape[1]
        options["parent_relative"] = options.get("parent_relative", True) and any(map(moving_parents, scenes))
        return cls(ParameterNames.of(first), layout=layout, features=chosen, counts=counts, **options)

    @property
    def parameter_normalizers(self) -> dict[str, Normalizer]:
        """Normalisers of the physical parameters, by part of the graph."""
        return {
            "nodes": self.parameter_node_normalizer,
            "edges": self.parameter_edge_normalizer,
            "globals_": self.parameter_global_normalizer,
        }

    @property
    def output_normalizers(self) -> list[Normalizer]:
        """Normalisers of the network's output: of residual changes, and of those relative to the parent's."""
        relative = self.relative_normalizer
        return [self.residual_normalizer] if relative is None else [self.residual_normalizer, relative]

    @property
    def fitted(self) -> bool:
        """True if all normalisers that the model reads have data; synchronises with the device."""
        read = [self.node_normalizer, self.edge_normalizer, *self.output_normalizers, self.delta_normalizer]
        if self.parameter_source == "scene":  # an inferred graph is not normalised
            read += self.parameter_normalizers.values()
        return all(normalizer.fitted for normalizer in read)

    def state_columns(self) -> dict[str, slice]:
        """Return the slice of each state component in the node features; empty without :class:`BodyState`."""
        start = 0
        for feature in self.features:
            if isinstance(feature, BodyState):
                where = self.layout.spatial.encoded_slices(feature.encoding)
                return {name: slice(start + part.start, start + part.stop) for name, part in where.items()}
            start += feature.size(self.layout) if feature.part == "nodes" else 0
        return {}

    def parameters_of(self, scene: Articulation) -> PhysicalParameters:
        """Return the parameters of a scene that the model reads; ValueError if the scene lacks some.

        The parts of an inferred graph are zeros.
        """
        values = self.parameter_names.select(scene)
        if self.parameter_source != "inferred":
            return values
        zeros = {
            part: getattr(values, part).new_zeros(*getattr(values, part).shape[:-1], size)
            for part, size in asdict(self.inferred_size).items()
        }
        return values._replace(**zeros)

    def bind(
        self,
        scene: Articulation | str | os.PathLike,
        *,
        strict: bool = False,
        reference: bool = False,
        parameters_key: NestedKey | None = None,
        parameter_names: ParameterNames | None = None,
    ) -> BoundPredictor:
        """Join these weights to a scene.

        Args:
            scene: the scene, or its name or path.
            strict: raise ValueError, instead of a warning, if the scene differs in a parameter, or moves in a way, that
                never varied in training.
            reference: evaluate the core by message passing: slow, and the reference for all faster ways.
            parameters_key: key of each sample's own physical parameters (a variant's, or inferred); None: all samples
                have the scene's.
            parameter_names: names of the parameters that each sample holds at that key, a data set's ``features``.
                Default: all of the scene.

        Raises:
            ValueError: if the scene or its samples lack parameters that the model reads, or with ``strict``.
        """
        options = {"parameters_key": parameters_key, "parameter_names": parameter_names}
        with torch.device("cpu"):  # constants of the scene need numbers, even if weights are made on the meta device
            return BoundPredictor(self, as_scene(scene), strict=strict, reference=reference, **options)

    def description(self) -> dict:
        """Return JSON-serialisable values for :meth:`from_description`; ValueError if a feature is not in FEATURES."""
        names = {kind: name for name, kind in FEATURES.items()}
        if unknown := [type(feature).__name__ for feature in self.features if type(feature) not in names]:
            raise ValueError(f"Features {unknown} have no name for a checkpoint: add them to FEATURES.")
        return {
            "parameter_names": asdict(self.parameter_names),
            "parameters": self.parameter_source,
            "inferred": list(asdict(self.inferred_size).values()),
            "layout": asdict(self.layout),
            "features": [{"feature": names[type(feature)], **feature.options()} for feature in self.features],
            "canonicalizer": asdict(self.canonicalizer),
            "integrate": self.integrate,
            "project": self.project,
            "parent_relative": self.parent_relative,
            "least_scales": self.least_scales,
            "physics": None if self.physics is None else self.physics.description(),
            "core": self.core_name,
            "counts": None if self.core.counts is None else list(self.core.counts),
            "core_options": {
                name: list(value) if isinstance(value, tuple) else value for name, value in self.core_options.items()
            },
        }

    @classmethod
    def from_description(
        cls, description: dict, *, physics: Callable[[Tensor, Tensor], Tensor] | None = None
    ) -> ForwardModel:
        """Build a model from its :meth:`description`, with fresh weights.

        Args:
            description: values of :meth:`description`.
            physics: the known physics, if they are a function. The description rebuilds physics from MJCF.

        Raises:
            ValueError: if a name is unknown, or physics are missing.
        """
        # Descriptions of older models lack these two.
        values = {"parent_relative": False, "least_scales": False, **description}
        known = physics_from_description(values.pop("physics", None), physics)
        features = []
        for each in values.pop("features"):
            options = dict(each)
            name = options.pop("feature")
            if name not in FEATURES:
                raise ValueError(
                    f"feature={name!r} is not known; use one of {list(FEATURES)}, or add yours to FEATURES."
                )
            features.append(FEATURES[name](**options))
        layout = StateLayout(tuple(Component(**component) for component in values.pop("layout")["components"]))
        return cls(
            ParameterNames.from_names(values.pop("parameter_names")),
            layout=layout,
            features=features,
            canonicalizer=Canonicalizer.from_description(values.pop("canonicalizer")),
            physics=known,
            **values.pop("core_options"),
            **values,
        )
