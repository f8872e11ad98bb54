"""Definition of the library's own systems, their model files, and resizing of geoms at constant density."""

from __future__ import annotations

import importlib.util
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np

# dm-control requires labmaze, unused here, which has no wheels for Python 3.13 and newer.
INSTALL_SUITE = 'pip install "torchrl_gn[suite]"'
if sys.version_info >= (3, 13):
    INSTALL_SUITE += " && pip install --no-deps dm-control"


@dataclass(frozen=True)
class ParameterRange:
    """Range of a parameter of random variants: a factor relative to the standard system, or an angle in radians."""

    low: float
    high: float
    standard: float = 1.0  # value of the standard system: 1 for factors, 0 for angles

    @property
    def is_angle(self) -> bool:
        return self.standard == 0


@dataclass(frozen=True)
class System:
    """A system of the paper (SM "Description of the simulated environments")."""

    name: str
    build: Callable[[], mujoco.MjSpec]
    timestep: float  # control step, seconds
    settle_steps: int = 0  # physics steps without control after a reset
    ranges: Mapping[str, ParameterRange] = field(default_factory=dict)  # parameters of variants, by name
    vary: Callable[[mujoco.MjSpec, Mapping[str, float]], None] | None = None  # applies parameters to a new model


def model_file(path: str) -> str:
    """Return the path of a dm_control model file (``"suite/cheetah.xml"``); ModuleNotFoundError if not installed."""
    # Importing dm_control would choose an OpenGL backend and complain without a display.
    package = importlib.util.find_spec("dm_control")
    if package is None or not package.submodule_search_locations:
        raise ModuleNotFoundError(f"The paper's systems need the model files of dm_control; run {INSTALL_SUITE}.")
    return str(Path(package.submodule_search_locations[0], path))


def suite_model(domain: str) -> mujoco.MjSpec:
    """Load the MJCF model of a Control Suite domain."""
    return mujoco.MjSpec.from_file(model_file(f"suite/{domain}.xml"))


def resize_capsule(geom: mujoco.MjsGeom, length: float, thickness: float) -> None:
    """Scale a capsule's length (between cap centres) and position by ``length``, its radius by ``thickness``."""
    before = _capsule_volume(geom)
    if np.isfinite(geom.fromto).all():
        geom.fromto = length * np.asarray(geom.fromto)
    else:
        geom.pos = length * np.asarray(geom.pos)
        geom.size = [geom.size[0], length * geom.size[1], geom.size[2]]
    geom.size = [thickness * geom.size[0], *geom.size[1:]]
    if np.isfinite(geom.mass):  # else MuJoCo computes it from the density
        geom.mass *= _capsule_volume(geom) / before


def resize_along_y(geom: mujoco.MjsGeom, length: float, thickness: float) -> None:
    """Scale a box's or ellipsoid's size and position by ``length`` along y, ``thickness`` across, and its mass."""
    scale = np.array([thickness, length, thickness])
    geom.pos, geom.size = scale * geom.pos, scale * geom.size
    geom.mass *= float(scale.prod())


def _capsule_volume(geom: mujoco.MjsGeom) -> float:
    if geom.type != mujoco.mjtGeom.mjGEOM_CAPSULE:
        raise ValueError(f"Geom {geom.name!r} is not a capsule.")
    radius, length = float(geom.size[0]), 2 * float(geom.size[1])
    if np.isfinite(geom.fromto).all():
        length = float(np.linalg.norm(geom.fromto[3:] - geom.fromto[:3]))
    return math.pi * radius**2 * (length + 4 / 3 * radius)
