"""Swimmer: a chain of links in a viscous plane; control step 20 ms, ten suite physics steps of 2 ms.

The suite's file holds the head; the other links are added as ``dm_control.suite.swimmer`` does.

Variants: length of every link, and one thickness for all. Masses follow the volume, joints stay at the ends of the
links; motors, armatures and joint limits stay.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import mujoco

from torchrl_gn.scenes.systems.system import ParameterRange, System, resize_along_y, resize_capsule, suite_model

_MOST_LINKS = 500  # compiling more takes MuJoCo many seconds


def swimmer(links: int) -> System:
    """Return the swimmer with ``links`` links, head included; ValueError below 3 and above 500."""
    if not 3 <= links <= _MOST_LINKS:
        raise ValueError(f"A swimmer has at least 3 links and at most {_MOST_LINKS}, got {links}.")
    ranges = {f"length_{name}": ParameterRange(0.3, 2.0) for name in _links(links)}
    ranges["thickness"] = ParameterRange(0.5, 5.0)
    return System(f"swimmer{links}", partial(_build, links), timestep=0.02, ranges=ranges, vary=partial(_vary, links))


def _links(links: int) -> list[str]:
    """Return the names of the bodies, head first."""
    return ["head", *(f"segment_{i}" for i in range(links - 1))]


def _build(links: int) -> mujoco.MjSpec:
    spec = suite_model("swimmer")
    default = {name: spec.find_default(name) for name in ("swimmer", "inertial", "visual")}
    parent = spec.body("head")
    limit = 360.0 / links  # degrees, as the suite
    for i in range(links - 1):
        parent = parent.add_body(name=f"segment_{i}", pos=[0, 0.1, 0])
        parent.add_geom(default["visual"], name=f"visual_{i}")
        parent.add_geom(default["inertial"], name=f"inertial_{i}")
        parent.add_site(default["swimmer"], name=f"site_{i}")
        parent.add_joint(default["swimmer"], name=f"joint_{i}", range=[-limit, limit])
        spec.add_actuator(spec.default, name=f"motor_{i}", target=f"joint_{i}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    return spec


def _vary(links: int, spec: mujoco.MjSpec, parameters: Mapping[str, float]) -> None:
    thickness, previous = parameters["thickness"], 0.0  # half length of the previous link, metres
    for name in _links(links):
        body, length = spec.body(name), parameters[f"length_{name}"]
        for geom in body.geoms:
            if geom.type == mujoco.mjtGeom.mjGEOM_CAPSULE:
                resize_capsule(geom, length, thickness)
            else:
                resize_along_y(geom, length, thickness)
        half = 0.05 * length
        for joint in body.joints:
            joint.pos = [0.0, -half, 0.0]
        if name != "head":
            body.pos = [0.0, previous + half, 0.0]
        previous = half
