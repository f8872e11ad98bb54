"""Check what a predictor is given: shapes, scenes, and parameters that never varied in training."""

from __future__ import annotations

import itertools
import warnings
from typing import TYPE_CHECKING

from tensordict import TensorDictBase
from torch import Tensor

from torchrl_gn.dynamics.features.feature import graph_edges
from torchrl_gn.scenes.kinematic_tree import KinematicTree
from torchrl_gn.scenes.scene import Scene

if TYPE_CHECKING:
    from torchrl_gn.dynamics.model import ForwardModel
    from torchrl_gn.dynamics.predictor import Predictor
    from torchrl_gn.maths.state_layout import StateLayout
    from torchrl_gn.scenes.physical_parameters import PhysicalParameters


class UnseenParameterWarning(UserWarning):
    """A scene has a physical parameter that the model never saw vary in training."""


def require_bound(model: object) -> None:
    """TypeError for a model of any scene, which predicts only once it is bound to one."""
    if hasattr(model, "bind"):
        raise TypeError(f"{type(model).__name__} is not bound to a scene: use model.bind(scene).")


def check_shapes(scene: Scene, state: Tensor, action: Tensor, parameters: TensorDictBase | None = None) -> None:
    """ValueError unless states are ``[*B, N, C]``, actions ``[*B, A]``, and parameters have that batch or none."""
    batch, wanted = state.shape[:-2], [scene.num_nodes, scene.state_size]
    if list(state.shape[-2:]) != wanted:
        raise ValueError(
            f"State of scene {scene.name!r} must be [*B, {', '.join(map(str, wanted))}], got {list(state.shape)}."
        )
    if action.shape != (*batch, scene.num_actions):
        raise ValueError(
            f"Action of scene {scene.name!r} must be {[*batch, scene.num_actions]} to go with a state"
            f" {list(state.shape)}, got {list(action.shape)}.{_past_commands(scene, action)}"
        )
    if parameters is not None and parameters.shape not in ((), batch):
        raise ValueError(
            f"Physical parameters must have no batch or that of the state, {list(batch)}, got {list(parameters.shape)}."
        )


def _past_commands(scene: Scene, action: Tensor) -> str:
    """What to do if an action may hold other numbers of past commands than a robot's tree."""
    commands = scene.num_actions // (scene.history + 1) if isinstance(scene, KinematicTree) else 0
    if not commands or action.shape[-1] % commands:
        return ""
    return f" If it holds past commands, give log_tree(..., history={action.shape[-1] // commands - 1})."


def check_scene(model: ForwardModel, scene: Scene, *, varies: bool) -> None:
    """ValueError if the graph has another size than the core reads, or shows parameters hidden from the model.

    ``varies``: whether each sample may be another variant of the scene.
    """
    counts, size = model.core.counts, (scene.num_nodes, graph_edges(scene, model.features).shape[1])
    if counts is not None and counts != size:
        raise ValueError(
            f"The model reads graphs of {counts[0]} nodes and {counts[1]} edges alone; scene {scene.name!r} has"
            f" {size[0]} and {size[1]}. Train another, or a graph network."
        )
    if varies and model.marks_edges:
        raise ValueError(
            "PairContacts has the geoms of one scene, but each sample may be another variant: leave the feature out."
        )
    if model.parameter_source != "scene" and "parameters" in getattr(scene, "origin", ()):
        raise ValueError(
            f"The model must not see true parameters (parameters={model.parameter_source!r}), and {scene.name!r} is a"
            " variant, whose joint anchors would show its lengths. Bind the model to the standard scene."
        )


def warn_of_unseen(predictor: Predictor, values: PhysicalParameters, name: str, *, stacklevel: int) -> None:
    """Warn, or raise ValueError with ``strict``, where a scene differs in a parameter constant in training."""
    model, unseen = predictor.model, []
    if predictor.movable.is_meta:  # there are no numbers to compare with
        return
    for part, normalizer in model.parameter_normalizers.items() if model.parameter_source == "scene" else ():
        mean = normalizer.mean
        given = getattr(values, part).to(mean.device)
        if given.shape[-1] == 0 or not bool((normalizer.count > 0).all()):
            continue
        # 1e-6: the same scene compiled on another machine may differ in the last digits.
        differs = ((given - mean).abs() > 1e-6 * mean.abs().clamp(min=1e-12)).reshape(-1, given.shape[-1]).any(0)
        for index in (normalizer.constant & differs).nonzero().flatten().tolist():
            unseen.append(getattr(model.parameter_names, part)[index])
    residual = model.residual_normalizer
    if model.physics is None and bool((residual.count > 0).any()):
        fixed = (predictor.movable & residual.constant).any(0).tolist()
        unseen += itertools.compress(_change_names(model.layout), fixed)
    if not unseen:
        return
    message = (
        f"Scene {name!r} has values that the model never saw, in features that never varied in its"
        f" training: {', '.join(unseen)}. They are ignored and predictions may be wrong."
    )
    if predictor.strict:
        raise ValueError(message)
    warnings.warn(message, UnseenParameterWarning, stacklevel=stacklevel)


def _change_names(layout: StateLayout) -> list[str]:
    """Names of the channels of a state change."""
    axes = {1: ("",), 3: (" x", " y", " z")}
    return [
        f"change of {component.name.replace('_', ' ')}{axis}"
        for component in layout.components
        for axis in axes.get(component.delta_size, [f" {index}" for index in range(component.delta_size)])
    ]
