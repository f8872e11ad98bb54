"""Pictures of states as arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from torchrl_gn.drawing.canvas import TRUTH
from torchrl_gn.scenes import Scene

if TYPE_CHECKING:
    from torchrl_gn.drawing.panels import SceneDrawing


def scene_drawing(scene: Scene, truth: np.ndarray, size: int) -> SceneDrawing:
    """Return the :class:`SceneDrawing` of a scene; ImportError without Pillow."""
    try:
        from torchrl_gn.drawing.panels import SceneDrawing
    except ImportError:
        raise ImportError('Pictures and videos need Pillow: pip install "torchrl_gn[figures]".') from None
    return SceneDrawing(scene, truth, size)


def draw_states(scene: Scene, states: Tensor, *, size: int = 360) -> np.ndarray:
    """Draw states ``[*B, N, 13]`` as uint8 pictures ``[*B, size, size, 3]`` at one scale; needs no display.

    Raises:
        ImportError: without Pillow.
        ValueError: if states have another shape, or are not finite.
    """
    flat = states.detach().double().cpu().numpy().reshape(-1, *states.shape[-2:])
    if flat.shape[1:] != (scene.num_nodes, scene.state_size) or not len(flat) or not np.isfinite(flat).all():
        raise ValueError(f"states must be [*B, {scene.num_nodes}, 13] and finite, got {list(states.shape)}.")
    drawing = scene_drawing(scene, flat, size)
    panels = (drawing.panel(step, drawing.truth, TRUTH) for step in range(len(flat)))
    pictures = np.stack([np.asarray(panel.reduce(panel.width // size)) for panel in panels])
    return pictures.reshape(*states.shape[:-2], *pictures.shape[1:])
