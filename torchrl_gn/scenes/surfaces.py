"""Surfaces of the world that bodies can touch: planes, boxes, hulls of meshes, height fields, ..."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_gn.scenes.invariance import surface_velocities

_GEOM = mujoco.mjtGeom
KINDS = ("plane", "box", "cylinder", "ellipsoid", "hull", "heights")
"""Shapes of surfaces; spheres and capsules count as rounded boxes."""
_KIND = {
    int(_GEOM.mjGEOM_PLANE): "plane",
    int(_GEOM.mjGEOM_SPHERE): "box",
    int(_GEOM.mjGEOM_CAPSULE): "box",
    int(_GEOM.mjGEOM_BOX): "box",
    int(_GEOM.mjGEOM_CYLINDER): "cylinder",
    int(_GEOM.mjGEOM_ELLIPSOID): "ellipsoid",
    int(_GEOM.mjGEOM_MESH): "hull",
    int(_GEOM.mjGEOM_HFIELD): "heights",
}
MOST_SURFACES = 12
MOST_FACES = 32  # of a mesh's hull


@dataclass(frozen=True, eq=False)
class Surface:
    """A geom that is fixed in the world."""

    geom: int
    kind: str  # one of KINDS
    # [22] position 3 and rotation 9 (row by row) in the world, half sizes 3, rounding radius 1, velocity 6 of a moving
    # surface in its own frame (linear, angular); SI units
    constants: np.ndarray
    # Hulls: outer normals and offsets [F, 4] of the faces. Height fields: heights [rows, columns] along y and x
    shape: np.ndarray | None = None
    reduced: bool = False  # True if MuJoCo's hull has more faces


def find_surface(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> Surface | None:
    """Describe a geom as a surface; None for signed distance fields and meshes without hull.

    ``data`` must have its kinematics done.
    """
    kind = _KIND.get(int(model.geom_type[geom]))
    size, rounding, shape, reduced = model.geom_size[geom].copy(), 0.0, None, False
    middle = np.zeros(3)  # centre of the surface in the geom's frame
    match mujoco.mjtGeom(model.geom_type[geom]):
        case _GEOM.mjGEOM_SPHERE:
            size, rounding = np.zeros(3), size[0]
        case _GEOM.mjGEOM_CAPSULE:
            size, rounding = np.array([0.0, 0.0, size[1]]), size[0]
        case _GEOM.mjGEOM_MESH:
            size = np.zeros(3)
            if (shape := _hull_faces(model, int(model.geom_dataid[geom]))) is not None:
                shape, reduced = shape[:MOST_FACES], len(shape) > MOST_FACES
        case _GEOM.mjGEOM_HFIELD:
            size, shape = _height_field(model, int(model.geom_dataid[geom]))
            if (shape == shape[0, 0]).all():  # flat: use a box, which the native executor supports
                depth = float(model.hfield_size[model.geom_dataid[geom], 3])
                middle[2], size[2] = (shape[0, 0] - depth) / 2, (shape[0, 0] + depth) / 2
                kind, shape = "box", None
        case _GEOM.mjGEOM_PLANE:
            size = np.zeros(3)  # a plane's size is only drawn
    if kind is None or (kind == "hull" and shape is None):
        return None
    rotation, (linear, angular) = data.geom_xmat[geom], np.split(surface_velocities(model)[geom], 2)
    pose = data.geom_xpos[geom] + rotation.reshape(3, 3) @ middle, rotation
    velocity = linear + np.cross(angular, middle), angular
    return Surface(geom, kind, np.concatenate((*pose, size, [rounding], *velocity)), shape, reduced)


def hull_vertices(model: mujoco.MjModel, mesh: int) -> np.ndarray | None:
    """Return the vertices ``[V, 3]`` of a mesh's convex hull, which MuJoCo collides; None without a hull."""
    start = int(model.mesh_graphadr[mesh])
    if start < 0:
        return None
    count = int(model.mesh_graph[start])
    return _vertices(model, mesh)[model.mesh_graph[start + 2 + count : start + 2 + 2 * count]]


def _vertices(model: mujoco.MjModel, mesh: int) -> np.ndarray:
    start = int(model.mesh_vertadr[mesh])
    return model.mesh_vert[start : start + int(model.mesh_vertnum[mesh])].astype(np.float64)


def _hull_faces(model: mujoco.MjModel, mesh: int) -> np.ndarray | None:
    """Return outer unit normals and offsets ``[F, 4]`` of a hull's faces, 32 spread over all directions first."""
    inside = hull_vertices(model, mesh)
    if inside is None:
        return None
    start = int(model.mesh_graphadr[mesh])
    vertices, faces = (int(count) for count in model.mesh_graph[start : start + 2])
    last = start + 2 + 3 * vertices + 6 * faces
    corners = _vertices(model, mesh)[model.mesh_graph[last - 3 * faces : last].reshape(faces, 3)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    has_area = areas > 1e-9 * areas.max()
    normals, areas, corners = normals[has_area] / areas[has_area, None], areas[has_area], corners[has_area]
    # Triangles are listed in either orientation.
    normals *= np.where(((corners[:, 0] - inside.mean(0)) * normals).sum(1) < 0, -1.0, 1.0)[:, None]
    planes = np.column_stack((normals, (inside @ normals.T).max(0)))
    _, first, group = np.unique(planes.round(6), axis=0, return_index=True, return_inverse=True)
    planes, areas = planes[first], np.bincount(group.ravel(), areas)
    first = _spread(planes[:, :3], MOST_FACES, areas)
    return planes[[*first, *np.setdiff1d(np.arange(len(planes)), first)]]


def _height_field(model: mujoco.MjModel, field: int) -> tuple[np.ndarray, np.ndarray]:
    """Return half sizes ``[3]`` along x and y (z: 0), and heights ``[rows, columns]``, metres."""
    rows, columns, start = (int(table[field]) for table in (model.hfield_nrow, model.hfield_ncol, model.hfield_adr))
    x, y, top, _ = model.hfield_size[field].tolist()
    heights = top * model.hfield_data[start : start + rows * columns].astype(np.float64)
    return np.array([x, y, 0.0]), heights.reshape(rows, columns)


def _spread(points: np.ndarray, count: int, weight: np.ndarray) -> np.ndarray:
    """Return indices of at most ``count`` points ``[P, 3]``, far apart, the one of largest weight ``[P]`` first."""
    chosen = [int(weight.argmax())]
    while len(chosen) < min(count, len(points)):
        away = np.linalg.norm(points[:, None] - points[chosen], axis=-1).min(1)
        chosen.append(int(away.argmax()))
    return np.array(chosen)
