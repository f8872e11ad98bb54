"""Geoms as rounded boxes, and candidates (segment and box) for the distance of two geoms."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import mujoco
import numpy as np

_GEOM = mujoco.mjtGeom
_PLANE = 1e3  # metres: half size of the box that replaces a plane
_NOT_THERE = (_GEOM.mjGEOM_HFIELD, _GEOM.mjGEOM_SDF, _GEOM.mjGEOM_FLEX, _GEOM.mjGEOM_SKIN)


class RoundedBox(NamedTuple):
    """All points within ``radius`` of a box; half sizes of 0 make it a segment or a point."""

    center: np.ndarray  # [3] in the node's frame, metres
    rotation: np.ndarray  # [3, 3] from the box's frame to the node's
    half: np.ndarray  # [3] metres
    radius: float  # metres

    @property
    def thin(self) -> bool:
        """True if the box is a segment or a point."""
        return int(np.count_nonzero(self.half)) <= 1

    def points(self, axis: np.ndarray | None = None) -> np.ndarray:
        """Return the corners ``[C, 3]`` in the node's frame; average corners that differ along ``axis`` alone."""
        signs = np.array(list(itertools.product((-1, 1), repeat=3)))
        corners = np.unique(signs * self.half + 0.0, axis=0) @ self.rotation.T + self.center
        if axis is None:
            return corners
        across = (corners - np.outer(corners @ axis, axis)).round(9) + 0.0
        _, groups = np.unique(across, axis=0, return_inverse=True)
        return np.array([corners[groups.ravel() == group].mean(0) for group in range(groups.max() + 1)])

    def distance(self, point: np.ndarray) -> float:
        """Return the distance of a point ``[3]`` in the node's frame, metres; ``-radius`` inside the unrounded box."""
        outside = np.abs((point - self.center) @ self.rotation) - self.half
        return float(np.linalg.norm(np.maximum(outside, 0))) - self.radius


class Candidate(NamedTuple):
    """A segment on one geom and the box of the other, whose distance may be the distance of the geoms."""

    on_second: bool  # True if the segment is on the second geom
    start: np.ndarray  # [3] in the frame of its node, metres
    direction: np.ndarray  # [3] from the start to the other end; 0 for a point
    box: RoundedBox  # of the other geom
    radius: float  # of the segment, metres
    has_ends: bool  # True if the segment's ends are candidates too


def rounded_box(model: mujoco.MjModel, data: mujoco.MjData, geom: int, root: int) -> RoundedBox | None:
    """Fit a rounded box to a geom, in the frame of its node's ``root`` body.

    Spheres, capsules, boxes and planes are exact. Ellipsoids and cylinders become boxes rounded by their smallest half
    size, meshes their bounding boxes. Height fields, signed distance fields, flexes and skins give None. ``data`` must
    have its kinematics done.
    """
    kind, size = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom].copy()
    if kind in _NOT_THERE:
        return None
    center, radius = np.zeros(3), 0.0
    if kind == _GEOM.mjGEOM_PLANE:
        center, size = np.array([0.0, 0.0, -_PLANE]), np.full(3, _PLANE)
    elif kind == _GEOM.mjGEOM_SPHERE:
        size, radius = np.zeros(3), float(size[0])
    elif kind == _GEOM.mjGEOM_CAPSULE:
        size, radius = np.array([0.0, 0.0, size[1]]), float(size[0])
    elif kind in (_GEOM.mjGEOM_ELLIPSOID, _GEOM.mjGEOM_CYLINDER):
        size = size if kind == _GEOM.mjGEOM_ELLIPSOID else size[[0, 0, 1]]
        radius = float(size.min())
        size = size - radius
    elif kind == _GEOM.mjGEOM_MESH:
        center, size = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    frame, rotation = data.xmat[root].reshape(3, 3), data.geom_xmat[geom].reshape(3, 3)
    center = frame.T @ (data.geom_xpos[geom] + rotation @ center - data.xpos[root])
    return RoundedBox(center, frame.T @ rotation, size, radius)


def candidates(
    first: RoundedBox, second: RoundedBox, axes: tuple[np.ndarray | None, np.ndarray | None] = (None, None)
) -> list[Candidate]:
    """Return the features of two geoms that may be closest: segments or points of one, against the other.

    Two segments give one candidate, a segment against the other. A segment and a box give three: the segment and both
    of its ends. Two boxes give the corners of each. Crossing edges of two boxes are missed.

    Args:
        axes: normal of the plane of a planar motion, in the frame of each node; None for other motions.
    """
    if not (first.thin or second.thin):
        return [
            Candidate(bool(side), point, np.zeros(3), box, geom.radius, False)
            for side, (geom, box) in enumerate(((first, second), (second, first)))
            for point in geom.points(axes[side])
        ]
    on_second = not first.thin
    segment, box = (second, first) if on_second else (first, second)
    end_points = segment.points()
    has_ends = len(end_points) == 2 and not box.thin
    contacts = [Candidate(on_second, end_points[0], end_points[-1] - end_points[0], box, segment.radius, has_ends)]
    return contacts + [
        Candidate(on_second, end, np.zeros(3), box, segment.radius, False) for end in end_points if has_ends
    ]
