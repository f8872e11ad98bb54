"""Geoms as rounded boxes, and the pairs of segment and box whose distances are those of two of them."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import mujoco
import numpy as np

_GEOM = mujoco.mjtGeom
_PLANE = 1e3  # metres: half sizes of the box that stands for a plane
_NOT_THERE = (_GEOM.mjGEOM_HFIELD, _GEOM.mjGEOM_SDF, _GEOM.mjGEOM_FLEX, _GEOM.mjGEOM_SKIN)


class RoundedBox(NamedTuple):
    """All points within ``radius`` of a box; of a segment or a point where half sizes are 0."""

    center: np.ndarray  # [3] in the node's frame, metres
    rotation: np.ndarray  # [3, 3] from the box's frame to the node's
    half: np.ndarray  # [3] metres
    radius: float  # metres

    @property
    def thin(self) -> bool:
        """Whether the box is a segment or a point."""
        return int(np.count_nonzero(self.half)) <= 1

    def points(self, axis: np.ndarray | None = None) -> np.ndarray:
        """Corners ``[C, 3]`` of the box in the node's frame; middles of those that differ along ``axis`` alone."""
        signs = np.array(list(itertools.product((-1, 1), repeat=3)))
        corners = np.unique(signs * self.half + 0.0, axis=0) @ self.rotation.T + self.center
        if axis is None:
            return corners
        across = (corners - np.outer(corners @ axis, axis)).round(9) + 0.0
        _, groups = np.unique(across, axis=0, return_inverse=True)
        return np.array([corners[groups.ravel() == group].mean(0) for group in range(groups.max() + 1)])

    def distance(self, point: np.ndarray) -> float:
        """Distance of a point ``[3]`` in the node's frame, metres; from the box less rounding if inside."""
        outside = np.abs((point - self.center) @ self.rotation) - self.half
        return float(np.linalg.norm(np.maximum(outside, 0))) - self.radius


class Candidate(NamedTuple):
    """A segment on one geom whose distance from the box of the other may be that of the geoms."""

    on_second: bool  # whether the segment is on the second geom
    start: np.ndarray  # [3] in the frame of its node, metres
    direction: np.ndarray  # [3] from there to the other end
    box: RoundedBox  # of the other geom
    radius: float  # of the segment, metres
    has_ends: bool  # whether the segment's ends are candidates too


def rounded_box(model: mujoco.MjModel, data: mujoco.MjData, geom: int, root: int) -> RoundedBox | None:
    """A geom in the frame of its node's ``root`` body; None of height fields, signed distance fields and skins.

    Spheres, capsules, boxes and planes are exact. Ellipsoids and cylinders become boxes rounded by their smallest half
    size, meshes their bounding boxes. ``data`` has its kinematics done.
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
    """What may be nearest of two geoms.

    Two segments: one against the other. A segment and a box: the segment and both its ends. Two boxes: the corners of
    each; that edges of two boxes cross is not seen. ``axes`` are, in both nodes' frames, what their planar motion turns
    about.
    """
    if not (first.thin or second.thin):
        return [
            Candidate(bool(side), point, np.zeros(3), box, geom.radius, False)
            for side, (geom, box) in enumerate(((first, second), (second, first)))
            for point in geom.points(axes[side])
        ]
    on_second = not first.thin
    segment, box = (second, first) if on_second else (first, second)
    ends = segment.points()
    has_ends = len(ends) == 2 and not box.thin
    found = [Candidate(on_second, ends[0], ends[-1] - ends[0], box, segment.radius, has_ends)]
    return found + [Candidate(on_second, end, np.zeros(3), box, segment.radius, False) for end in ends if has_ends]
