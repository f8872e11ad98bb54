"""Bounds of the controls: the model's, implied by forces and joints, or the user's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from torchrl_gn.scenes.actuator_kinds import actuator_kind, drive_joints, holding_controls
from torchrl_gn.scenes.scene import SceneError

if TYPE_CHECKING:
    from torchrl_gn.scenes.articulation import Articulation

_SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))

ActionBounds = Mapping[str, Sequence[float]] | Sequence[float]
"""``(low, high)`` of actuators by name, or one pair for all that have no other bounds."""


def set_control_bounds(
    model: mujoco.MjModel, names: Sequence[str], chosen: ActionBounds | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds ``[A]`` of the controls, infinite if unbounded; write finite ones into the model, which clamps.

    The first of these applies: the pair ``chosen`` by name; ``ctrlrange``; the control at which a motor's force reaches
    its ``forcerange``, else its joint's ``actuatorfrcrange``; the range of a position servo's joint; 0 to 1 for a
    muscle; the pair ``chosen`` for all.

    Raises:
        ValueError: if a name is unknown or a pair is not two finite numbers in ascending order.
    """
    by_name = {name: _checked(pair, name) for name, pair in chosen.items()} if isinstance(chosen, Mapping) else {}
    if unknown := [name for name in by_name if name not in names]:
        raise ValueError(f"action_bounds name {unknown}, which are none of the actuators {list(names)}.")
    for_all = None if chosen is None or isinstance(chosen, Mapping) else _checked(chosen, "all actuators")
    bounds = np.tile([-np.inf, np.inf], (len(names), 1))
    for actuator, name in enumerate(names):
        if name not in by_name and model.actuator_ctrllimited[actuator]:
            bounds[actuator] = model.actuator_ctrlrange[actuator]
            continue
        low_high = by_name.get(name) or _implied(model, actuator) or for_all
        if low_high is not None:
            bounds[actuator] = model.actuator_ctrlrange[actuator] = low_high
            model.actuator_ctrllimited[actuator] = 1
    return bounds[:, 0].copy(), bounds[:, 1].copy()


def require_bounds(scene: Articulation) -> None:
    """Raise SceneError, naming the actions, if some have no bounds to draw from."""
    if scene.unbounded:
        raise SceneError(
            f"Actions {list(scene.unbounded)} of scene {scene.name!r} have no bounds to draw from. Give their actuators"
            " a ctrlrange, or load the scene with action_bounds={name: (low, high)}."
        )


def plain_bounds(chosen: ActionBounds) -> dict[str, list[float]] | list[float]:
    """Return the bounds as JSON-able values."""
    if isinstance(chosen, Mapping):
        return {name: list(_checked(pair, name)) for name, pair in chosen.items()}
    return list(_checked(chosen, "all actuators"))


def _checked(pair: Sequence[float], owner: str) -> tuple[float, float]:
    if isinstance(pair, str) or len(pair) != 2 or not -np.inf < float(pair[0]) < float(pair[1]) < np.inf:
        raise ValueError(f"action_bounds of {owner} must be two finite numbers, low then high, got {pair!r}.")
    return float(pair[0]), float(pair[1])


def _implied(model: mujoco.MjModel, actuator: int) -> tuple[float, float] | None:
    """Derive bounds from a motor's or its joint's force limits, a servo's joint, a muscle (0 to 1); None otherwise."""
    if model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_MUSCLE:
        return 0.0, 1.0
    gain, joint = float(model.actuator_gainprm[actuator, 0]), int(model.actuator_trnid[actuator, 0])
    if actuator_kind(model, actuator) == "position":
        if not (drive_joints(model)[actuator] and model.jnt_limited[joint] and model.jnt_type[joint] in _SCALAR):
            return None
        limits = holding_controls(model, actuator, model.jnt_range[joint] * model.actuator_gear[actuator, 0])
    elif (
        model.actuator_gaintype[actuator] != mujoco.mjtGain.mjGAIN_FIXED
        or gain == 0
        or model.actuator_biastype[actuator] != mujoco.mjtBias.mjBIAS_NONE
    ):
        return None
    elif model.actuator_forcelimited[actuator]:
        limits = model.actuator_forcerange[actuator] / gain
    else:
        gear = float(model.actuator_gear[actuator, 0])
        scalar = drive_joints(model)[actuator] and model.jnt_type[joint] in _SCALAR and gear != 0
        if not (scalar and model.jnt_actfrclimited[joint]):
            return None
        limits = model.jnt_actfrcrange[joint] / (gain * gear)
    low, high = sorted(map(float, limits))
    return (low, high) if low < high else None
