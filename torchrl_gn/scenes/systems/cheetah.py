"""Cheetah: the suite's planar half-cheetah; control step 10 ms, one suite physics step.

As in the suite, it settles for 200 physics steps after a reset.

Variants: reference angles of thighs, shins and feet relative to their parents, length of every body (the head scales
with the torso), and one thickness for all. Masses follow the volume, joints move with the lengths; motors, springs and
limits stay. The lowest point at the reference is as high above the ground as the standard cheetah's.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import mujoco
import numpy as np

from torchrl_gn.scenes.systems.system import ParameterRange, System, resize_capsule, suite_model

_LIMBS = ("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")
_RANGES = {
    **{f"angle_{limb}": ParameterRange(-0.1, 0.1, standard=0.0) for limb in _LIMBS},
    **{f"length_{body}": ParameterRange(0.5, 2.0) for body in ("torso", *_LIMBS)},
    "thickness": ParameterRange(0.5, 2.0),
}


def _build() -> mujoco.MjSpec:
    """Build the suite's model with densities in place of ``settotalmass``, which would fix the mass of all variants."""
    spec = suite_model("cheetah")
    total = spec.compiler.settotalmass
    spec.compiler.settotalmass = -1.0
    scale = total / spec.compile().body_mass.sum()
    for geom in spec.geoms:
        geom.density *= scale
    return spec


def _vary(spec: mujoco.MjSpec, parameters: Mapping[str, float]) -> None:
    for name in ("torso", *_LIMBS):
        body, length = spec.body(name), parameters[f"length_{name}"]
        for geom in body.geoms:
            resize_capsule(geom, length, parameters["thickness"])
        for child in body.bodies:
            child.pos = length * np.asarray(child.pos)
        if name in _LIMBS:
            half = 0.5 * parameters[f"angle_{name}"]
            body.quat = [np.cos(half), 0.0, np.sin(half), 0.0]
    torso = spec.body("torso")
    torso.pos = [*torso.pos[:2], torso.pos[2] + (_clearance() - _lowest(spec))]


@cache
def _clearance() -> float:
    """Return the height of the standard cheetah's lowest point, metres."""
    return _lowest(_build())


def _lowest(spec: mujoco.MjSpec) -> float:
    """Return the height of the capsules' lowest point, all joints at zero, metres."""
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    capsules = model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE
    reach = np.abs(data.geom_xmat[:, 8]) * model.geom_size[:, 1] + model.geom_size[:, 0]
    return float((data.geom_xpos[:, 2] - reach)[capsules].min())


SYSTEM = System("cheetah", _build, timestep=0.01, settle_steps=200, ranges=_RANGES, vary=_vary)
