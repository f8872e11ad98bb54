"""Check what a predictor is given."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tensordict import TensorDictBase
from torch import Tensor

from torchrl_gn.scenes.scene import Scene

if TYPE_CHECKING:
    from torchrl_gn.dynamics.model import ForwardModel


def check_shapes(scene: Scene, state: Tensor, action: Tensor, parameters: TensorDictBase | None = None) -> None:
    """Refuse what does not fit a scene.

    Args:
        scene: the scene.
        state: should be ``[*B, N, C]``, with ``C`` the scene's ``state_size``.
        action: should be ``[*B, A]``.
        parameters: should have the same batch, or none.

    Raises:
        ValueError: naming what does not.
    """
    batch, wanted = state.shape[:-2], [scene.num_nodes, scene.state_size]
    if list(state.shape[-2:]) != wanted:
        raise ValueError(
            f"State of scene {scene.name!r} must be [*B, {', '.join(map(str, wanted))}], got {list(state.shape)}."
        )
    if action.shape != (*batch, scene.num_actions):
        raise ValueError(
            f"Action of scene {scene.name!r} must be {[*batch, scene.num_actions]} to go with a state"
            f" {list(state.shape)}, got {list(action.shape)}."
        )
    if parameters is not None and parameters.shape not in ((), batch):
        raise ValueError(
            f"Physical parameters must have no batch or that of the state, {list(batch)}, got {list(parameters.shape)}."
        )


def check_scene(model: ForwardModel, scene: Scene) -> None:
    """Refuse a scene that a model cannot be bound to.

    Raises:
        ValueError: if its graph has another size than the core reads, or it shows parameters hidden from the model.
    """
    counts = model.core.counts
    if counts is not None and counts != (scene.num_nodes, scene.num_edges):
        raise ValueError(
            f"The model reads graphs of {counts[0]} nodes and {counts[1]} edges alone; scene {scene.name!r} has"
            f" {scene.num_nodes} and {scene.num_edges}. Train another, or a graph network."
        )
    if model.parameter_source != "scene" and "parameters" in getattr(scene, "origin", ()):
        raise ValueError(
            f"The model must not see true parameters (parameters={model.parameter_source!r}), and {scene.name!r} is a"
            " variant, whose joint anchors would show its lengths. Bind the model to the standard scene."
        )
