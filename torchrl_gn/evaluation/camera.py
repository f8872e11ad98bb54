"""Camera of a scene: straight at the plane of motion, or oblique for spatial motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from torchrl_gn.scenes import Scene

_AZIMUTH, _ELEVATION = np.radians(-55.0), np.radians(18.0)


@dataclass(frozen=True, eq=False)
class View:
    """A parallel projection."""

    right: np.ndarray  # [3] unit vector that points right in the picture
    up: np.ndarray  # [3] up
    toward: np.ndarray  # [3] towards the viewer
    planar: bool  # whether everything moves in the plane of the picture

    def project(self, points: np.ndarray) -> np.ndarray:
        """World points ``[..., 3]`` to picture coordinates ``[..., 2]``, metres."""
        return points @ np.stack((self.right, self.up), axis=-1)


def choose_view(scene: Scene) -> View:
    """View straight at the plane of motion, if no node leaves it; oblique from above if the motion is spatial."""
    movable = np.asarray(scene.movable.any(axis=0))
    x, y, z = np.eye(3)
    # From above for z; from the front, with z up, for the others.
    for normal, (right, up) in ((1, (x, z)), (2, (x, y)), (0, (y, z))):
        others = [axis for axis in range(3) if axis != normal]
        if not movable[normal] and not movable[[3 + axis for axis in others]].any():
            return View(right, up, np.cross(right, up), True)
    flat = np.array([np.cos(_AZIMUTH), np.sin(_AZIMUTH), 0.0])
    toward = np.cos(_ELEVATION) * flat + np.sin(_ELEVATION) * z
    right = np.cross(z, flat)
    return View(right, np.cross(toward, right), toward, False)


def follow(scene: Scene, states: np.ndarray) -> np.ndarray:
    """Point ``[T, 3]`` that the camera follows for states ``[T, N, 13]``.

    Mean of the moving nodes, along translation-invariant axes only.
    """
    center = states[:, scene.predicted, :3].mean(axis=1)
    return np.where(scene.translation_invariant, center, 0.0)
