"""A scene with other numbers in its MuJoCo model, to simulate."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import mujoco

from torchrl_gn.scenes.scene import Scene


def scaled_scene(scene: Scene, factors: Iterable[tuple[str, Any, float]]) -> Scene:
    """The scene with rows of arrays of its ``mjModel`` multiplied: the array's name, which rows, the factor.

    For simulation alone: what models read of the scene stays.
    """
    model = copy.copy(scene.model)
    for array, rows, factor in factors:
        getattr(model, array)[rows] *= factor
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return replace(scene, model=model)
