"""Errors of baselines that do not learn."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_gn.dynamics import ConstantVelocity
from torchrl_gn.dynamics.features.controls import ControlInputs
from torchrl_gn.evaluation.error_table import ErrorTable
from torchrl_gn.evaluation.errors import evaluate_errors
from torchrl_gn.scenes import Articulation


def baseline_errors(
    scene: Articulation,
    trajectories: TensorDictBase,
    physics: Callable[[Tensor, Tensor], Tensor] | None = None,
    **options: Any,
) -> dict[str, ErrorTable]:
    """Return error tables of the baselines ``"constant velocity"`` and, if given, ``"physics"`` alone.

    All errors are relative to the persistence baseline, whose errors are 1. ``options`` are passed to
    :func:`~torchrl_gn.evaluation.evaluate_errors`.
    """
    layout = scene.layout
    known: dict[str, Callable] = {"constant velocity": ConstantVelocity(layout, float(scene.timestep))}
    if physics is not None:
        known["physics"] = physics
    tables = {}
    controls = ControlInputs(scene)
    for name, function in known.items():
        module: Any = TensorDictModule(partial(_step, function, controls), ["state", "action"], [("next", "state")])
        module.layout, module.scene = layout, scene
        module.function = function  # its tensors set the device
        tables[name] = evaluate_errors(module, trajectories, **options)
    return tables


def _step(
    function: Callable[[Tensor, Tensor], Tensor], controls: ControlInputs, state: Tensor, action: Tensor
) -> Tensor:
    return function(state, controls.to(action.device).commands(action))
