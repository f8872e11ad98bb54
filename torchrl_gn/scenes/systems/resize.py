"""Changing the size of geoms at constant density."""

from __future__ import annotations

import math

import mujoco
import numpy as np

_GEOM = mujoco.mjtGeom


def resize_capsule(geom: mujoco.MjsGeom, length: float, thickness: float) -> None:
    """Multiply a capsule's length (between the centres of its caps) and radius, and its place by the length.

    A mass that the model gives follows the volume; without one MuJoCo computes it from the density.
    """
    before = _capsule_volume(geom)
    if np.isfinite(geom.fromto).all():
        geom.fromto = length * np.asarray(geom.fromto)
    else:
        geom.pos = length * np.asarray(geom.pos)
        geom.size = [geom.size[0], length * geom.size[1], geom.size[2]]
    geom.size = [thickness * geom.size[0], *geom.size[1:]]
    if np.isfinite(geom.mass):
        geom.mass *= _capsule_volume(geom) / before


def resize_along_y(geom: mujoco.MjsGeom, length: float, thickness: float) -> None:
    """Multiply a box's or ellipsoid's size and place along y by one number, across it by another.

    Its mass follows the volume.
    """
    scale = np.array([thickness, length, thickness])
    geom.pos, geom.size = scale * geom.pos, scale * geom.size
    geom.mass *= float(scale.prod())


def _capsule_volume(geom: mujoco.MjsGeom) -> float:
    """Cubic metres."""
    if geom.type != _GEOM.mjGEOM_CAPSULE:
        raise ValueError(f"Geom {geom.name!r} is no capsule.")
    radius, length = float(geom.size[0]), 2 * float(geom.size[1])
    if np.isfinite(geom.fromto).all():
        length = float(np.linalg.norm(geom.fromto[3:] - geom.fromto[:3]))
    return math.pi * radius**2 * (length + 4 / 3 * radius)
