"""Shapes of what a model is given."""

from __future__ import annotations

from tensordict import TensorDictBase
from torch import Tensor

from torchrl_gn.scenes.scene import Scene


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
