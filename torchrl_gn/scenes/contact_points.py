"""Contact points: where bodies can touch a plane fixed in the world."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from torchrl_gn.scenes.collisions import colliding_geoms
from torchrl_gn.scenes.topology import Topology

if TYPE_CHECKING:
    from torchrl_gn.scenes.scene import Scene

_GEOM = mujoco.mjtGeom

SHAPES = tuple(map(int, (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CAPSULE, _GEOM.mjGEOM_BOX, _GEOM.mjGEOM_ELLIPSOID)))
"""Types of geoms that have contact points."""
SLOTS = 4
"""Contact points per node that models read: the ones farthest from the node's origin."""


@dataclass(frozen=True, eq=False)
class ContactPoints:
    """Spheres whose lowest points can touch the plane."""

    node: np.ndarray  # [C] node of each point
    offset: np.ndarray  # [C, 3] centre of the sphere in the node's frame, metres
    radius: np.ndarray  # [C] metres; 0 for a corner
    normal: np.ndarray  # [3] normal of the plane, world frame
    origin: np.ndarray  # [3] a point on the plane, metres
    plane: int  # geom


def find_contact_points(model: mujoco.MjModel, data: mujoco.MjData, graph: Topology) -> ContactPoints | None:
    """Find the points that can touch a scene's first reachable plane; None if there are none.

    Points are spheres, ends of capsules, corners of boxes and ends of ellipsoid axes; cylinders and meshes have none.
    ``data`` must be at its reference, kinematics done.
    """
    of_geom, colliding = graph.node_of_body[model.geom_bodyid], colliding_geoms(model)
    for plane in np.flatnonzero((model.geom_type == _GEOM.mjGEOM_PLANE) & (of_geom == 0)):
        spheres = []
        for geom in np.flatnonzero((of_geom > 0) & colliding[plane]):
            node = int(of_geom[geom])
            root = graph.body[node]
            rotation, frame = data.geom_xmat[geom].reshape(3, 3), data.xmat[root].reshape(3, 3)
            for point, radius in _spheres(int(model.geom_type[geom]), model.geom_size[geom]):
                spheres.append((node, frame.T @ (data.geom_xpos[geom] + rotation @ point - data.xpos[root]), radius))
        if spheres:
            nodes, offsets, radii = (np.array(column) for column in zip(*spheres, strict=True))
            normal, origin = data.geom_xmat[plane, 2::3].copy(), data.geom_xpos[plane].copy()
            return ContactPoints(nodes, offsets, radii, normal, origin, int(plane))
    return None


def _spheres(kind: int, size: np.ndarray) -> list[tuple[np.ndarray, float]]:
    """Return centres and radii of a geom's contact points in its frame."""
    if kind == _GEOM.mjGEOM_SPHERE:
        return [(np.zeros(3), float(size[0]))]
    if kind == _GEOM.mjGEOM_CAPSULE:
        return [(np.array([0.0, 0.0, sign * size[1]]), float(size[0])) for sign in (1, -1)]
    if kind == _GEOM.mjGEOM_BOX:
        # A tetrahedron first: only SLOTS equally far corners are kept, and those of one face would hide the others.
        corners = sorted(itertools.product((1, -1), repeat=3), key=math.prod, reverse=True)
        return [(np.array(signs) * size, 0.0) for signs in corners]
    if kind == _GEOM.mjGEOM_ELLIPSOID:
        return [(sign * size * axis, 0.0) for axis in np.eye(3) for sign in (1, -1)]
    return []


def contact_slots(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return offsets ``[N, 4, 3]``, radii ``[N, 4]`` and mask ``[N, 4]`` of the kept points."""
    shape, points = (scene.num_nodes, SLOTS), scene.contact_points
    offset, radius, mask = np.zeros((*shape, 3)), np.zeros(shape), np.zeros(shape, dtype=bool)
    if points is None:
        return offset, radius, mask
    for node in np.unique(points.node):
        own = np.flatnonzero(points.node == node)
        reach = np.linalg.norm(points.offset[own], axis=1) + points.radius[own]
        # Rounded, so that equally far points keep their order in every variant of a scene.
        chosen = own[np.argsort(-reach.round(9), kind="stable")[:SLOTS]]
        slots = node, slice(len(chosen))
        offset[slots], radius[slots], mask[slots] = points.offset[chosen], points.radius[chosen], True
    return offset, radius, mask
