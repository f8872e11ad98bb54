"""Resize geoms at constant density."""

from __future__ import annotations

import math

import mujoco
import numpy as np


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
