"""Scenes with scaled numbers of their MuJoCo model, such as masses, gears or dampings."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from torchrl_gn.scenes.articulation import require_bodies
from torchrl_gn.scenes.build import read_numbers
from torchrl_gn.scenes.idle_numbers import why_idle
from torchrl_gn.scenes.scene import Scene
from torchrl_gn.scenes.topology import named, topology
from torchrl_gn.scenes.transmissions import find_transmissions

_KINDS = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "jnt": mujoco.mjtObj.mjOBJ_JOINT,
    "dof": mujoco.mjtObj.mjOBJ_JOINT,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "tendon": mujoco.mjtObj.mjOBJ_TENDON,
}
_FROM_REFERENCE = ("eq_data", "tendon_length0", "actuator_length0")  # computed from poses in the reference

_RADII: dict[int, Callable[[np.ndarray], float]] = {  # of a geom's bounding sphere, from its size
    int(mujoco.mjtGeom.mjGEOM_SPHERE): lambda size: size[0],
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): lambda size: size[0] + size[1],
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): lambda size: float(size.max()),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): lambda size: float(np.hypot(size[0], size[1])),
    int(mujoco.mjtGeom.mjGEOM_BOX): lambda size: float(np.linalg.norm(size)),
}

Chosen = Mapping[str, Sequence[str | Sequence[str]] | None]
"""Names of bodies, joints, geoms, actuators or tendons by array of ``mjModel``, as in
``{"body_mass": ["hand"], "dof_damping": None}``. None is for all whose number is not 0 and has an effect. Names in a
tuple share one parameter: ``{"dof_damping": [("left", "right")]}``. A body's mass includes its inertia."""

DELAY = "actuator_delay"
"""Array of ``mjModel`` with the actuators' delays, seconds. They take no factors, because 0 is a usual delay."""

Factor = tuple[str, Sequence[int], float]
"""Name of an array of ``mjModel``, its rows, and the factor that multiplies them."""


def scaled_scene(scene: Scene, factors: Iterable[tuple[str, Any, float]]) -> Scene:
    """Return the scene with rows of its ``mjModel`` arrays multiplied; ``factors`` are (array, rows, factor).

    Use it for simulation only: the features that models read keep the old numbers.
    """
    model, mocap_arrays, factors = copy.copy(scene.model), _of_mocap_poses(scene.model), list(factors)
    for array, rows, factor in factors:
        getattr(model, array)[rows] *= factor
    try:
        mujoco.mj_setConst(model, mujoco.MjData(model))
    except mujoco.FatalError as error:
        raise ValueError(f"{scene.name!r} cannot have these factors: {error}") from error
    for array, change in mocap_arrays.items():
        getattr(model, array)[:] += change
    for geom in {int(row) for array, rows, _ in factors if array == "geom_size" for row in np.ravel(rows)}:
        _bound(model, geom)
    return replace(scene, model=model)


def _bound(model: mujoco.MjModel, geom: int) -> None:
    """Fit the bounding sphere of a geom to its size; ``mj_setConst`` of older MuJoCo does not.

    Older MuJoCo keeps its bounding volume hierarchies unchanged, too, so they are switched off.
    """
    radius_of = _RADII.get(int(model.geom_type[geom]))  # none of planes, and of shapes that do not depend on the size
    radius = model.geom_rbound[geom] if radius_of is None else radius_of(model.geom_size[geom])
    if not np.isclose(model.geom_rbound[geom], radius):
        model.geom_rbound[geom] = radius
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)


def _of_mocap_poses(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Return corrections, by array, to constants that ``mj_setConst`` computes, such as anchors.

    A scene moves mocap bodies to the keyframe's pose after compiling. Its constants still belong to the pose in the
    file, but ``mj_setConst`` computes them for the keyframe's pose.
    """
    if not model.nmocap:
        return {}
    again = copy.copy(model)
    mujoco.mj_setConst(again, mujoco.MjData(again))
    return {array: getattr(model, array) - getattr(again, array) for array in _FROM_REFERENCE}


def with_factors(scene: Scene, parameters: Chosen, factors: Sequence[float] | np.ndarray) -> Scene:
    """Return a variant of the scene, with chosen numbers of its MuJoCo model multiplied by factors.

    Simulations and models' features use the new numbers, as for variants of the paper's systems. Checkpoints store the
    factors.

    Args:
        scene: the scene to change; it stays as it is.
        parameters: names of bodies, joints, geoms, actuators or tendons by array of ``mjModel``, as in
            ``{"body_mass": ["pole"], "dof_damping": None}``; None: all whose number is not 0. Names in a tuple share
            a factor.
        factors: positive factors ``[P]``, in the order of the names.

    Raises:
        ValueError: if a name is unknown, a chosen number is 0 or without effect on the motion (the ``geom_size`` of a
            mesh, the range of a joint without limits), or factors do not fit or are not positive.
    """
    scene = require_bodies(scene, "with_factors")
    rows, values = find_numbers(scene.model, parameters)[1], np.asarray(factors, dtype=np.float64)
    if values.shape != (len(rows),):
        raise ValueError(f"There are {len(rows)} numbers, so factors must be [{len(rows)}], got {list(values.shape)}.")
    return variant_of(scene, [(*row, factor) for row, factor in zip(rows, values.tolist(), strict=True)])


def variant_of(scene: Scene, factors: Sequence[Factor]) -> Scene:
    """Return a variant with rows of its ``mjModel`` arrays multiplied; ValueError if a factor does not fit."""
    for array, rows, factor in factors:
        count = len(_numbers(scene.model, array))
        if not all(0 <= row < count for row in rows) or not 0 < factor < np.inf:
            raise ValueError(f"{array} has {count} rows, not {list(rows)}, or the factor {factor} is not above 0.")
    changed = scaled_scene(scene, with_inertia(factors))
    model = changed.model
    low, high = scene.action_low.copy(), scene.action_high.copy()
    limited = np.flatnonzero(model.actuator_ctrllimited)
    low[limited], high[limited] = model.actuator_ctrlrange[limited].T
    acting, is_system = find_transmissions(model, topology(model)), "system" in scene.origin
    origin = scene.origin
    if origin:  # a scene without one has no description anyway
        new_factors = [[array, list(rows), factor] for array, rows, factor in factors]
        origin = {**origin, "factors": [*origin.get("factors", []), *new_factors]}
    return replace(
        changed,
        **read_numbers(model, acting, scene.substeps, scene.mocaps, is_system=is_system),
        action_low=low,
        action_high=high,
        origin=origin,
    )


def with_inertia(factors: Iterable[Factor]) -> Iterator[Factor]:
    """Yield the factors; repeat each factor of a body's mass for its inertia."""
    for array, rows, factor in factors:
        yield array, rows, factor
        if array == "body_mass":
            yield "body_inertia", rows, factor


def find_numbers(
    model: mujoco.MjModel, parameters: Chosen, *, delays: bool = False
) -> tuple[tuple[str, ...], list[tuple[str, list[int]]]]:
    """Return names of the chosen numbers, such as ``"dof_armature elbow"``, and the array and rows of each.

    With ``delays``, they may include :data:`DELAY`, of any actuator.

    Raises:
        ValueError: if a name is unknown or named twice, a named number is 0 or has no effect, or no chosen number has
            an effect.
        TypeError: if ``parameters`` is not a dictionary.
    """
    if not isinstance(parameters, Mapping):
        raise TypeError(
            'The numbers to change must be a dictionary, such as {"dof_damping": ["elbow"]}, or {"dof_damping": None}'
            f" for all joints; got {parameters!r}."
        )
    names, rows = [], []
    for array, chosen in parameters.items():
        # A delay of 0 is one to estimate, and MuJoCo before 3.5 has no array of delays.
        late = delays and array == DELAY
        values, element = np.ones(model.nu) if late else _numbers(model, array), array.split("_")[0]
        kind = _KINDS[element]
        count = {"body": model.nbody, "jnt": model.njnt, "dof": model.njnt, "geom": model.ngeom}.get(
            element, model.nu if kind == mujoco.mjtObj.mjOBJ_ACTUATOR else model.ntendon
        )
        all_names = [named(model, kind, index) for index in range(count)]
        groups = [
            (name,) if isinstance(name, str) else tuple(name) for name in (all_names if chosen is None else chosen)
        ]
        flat = [name for group in groups for name in group]
        if unknown := [name for name in flat if name not in all_names]:
            raise ValueError(f"{array}: the model has no {unknown[0]!r}, only {all_names}.")
        if again := [name for name in flat if flat.count(name) > 1]:
            raise ValueError(f"{array}: {again[0]!r} is named twice.")
        for group in groups:
            where = []
            for name in group:
                index = all_names.index(name)
                own = np.flatnonzero(model.dof_jntid == index).tolist() if element == "dof" else [index]
                zero, why = not (values[own] != 0).any(), why_idle(model, array, index)
                if zero and chosen is not None:
                    raise ValueError(f"{array} of {name!r} is 0, so a factor has no effect: set it in the scene first.")
                if why and chosen is not None:
                    raise ValueError(f"{array} of {name!r} would have no effect: {why}. Leave it out.")
                where += [] if zero or why else own
            if where:
                more = f" and {len(group) - 1} more" if group[1:] else ""
                names.append(f"{array} {group[0]}{more}")
                rows.append((array, where))
    if not names:
        raise ValueError("There is nothing to change: all numbers that parameters= names are 0 or have no effect.")
    return tuple(names), rows


def _numbers(model: mujoco.MjModel, array: str) -> np.ndarray:
    """Return a floating-point array of a model; ValueError if there is none of that name."""
    if array == DELAY:
        raise ValueError(f"{DELAY} must be whole physics steps, so it takes no factor: change it in the file.")
    values = getattr(model, array, None) if str(array).split("_")[0] in _KINDS else None
    if not isinstance(values, np.ndarray) or not np.issubdtype(values.dtype, np.floating):
        raise ValueError(f"{array!r} is not an array of mjModel with numbers of {list(_KINDS)}.")
    return values
