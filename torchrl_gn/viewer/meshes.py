"""Triangle meshes of MuJoCo's geoms, in the colours of its viewers."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from torchrl_gn.drawing.geometry import SceneGeometry
from torchrl_gn.scenes import Scene, has_target

_Geom = mujoco.mjtGeom
_SIDES = 32  # of a round outline
_RINGS = 16  # from pole to pole of a sphere
_GREY = np.array([0.5, 0.5, 0.5, 1.0], dtype=np.float32)  # MuJoCo's default, which a material replaces
_ENDLESS = 10.0  # metres, half side of a plane without a size
_CREASE = np.cos(np.radians(35))  # of the angle between faces; a larger angle is a sharp edge

Mesh = tuple[np.ndarray, np.ndarray]  # vertices [V, 3], metres; faces [F, 3], counter-clockwise from outside


@dataclass(frozen=True, eq=False)
class Part:
    """Geoms of one colour on one node, as one mesh."""

    node: int
    vertices: np.ndarray  # [V, 3] in the node's frame, metres
    faces: np.ndarray  # [F, 3] counter-clockwise from outside
    rgba: tuple[float, float, float, float]  # 0 to 1


def scene_parts(scene: Scene) -> list[Part]:
    """Return the visible geoms of a scene by node and colour, without its level planes, which are the ground.

    A target of the suite is left out, too: every episode has it elsewhere.
    """
    model, geometry = scene.model, SceneGeometry(scene)
    targeted = "suite" in scene.origin and has_target(scene.origin["suite"])
    meshes: dict[tuple, list[Mesh]] = {}
    for geom in visible_geoms(model):
        node, matrix = int(geometry.geom_node[geom]), geometry.geom_mat[geom]
        if model.geom_type[geom] == _Geom.mjGEOM_PLANE and node == 0 and matrix[2, 2] > 0.99:
            continue
        if targeted and model.geom(geom).name == "target":
            continue
        vertices, faces = geom_mesh(model, geom)
        key = node, tuple(np.round(geom_rgba(model, geom), 4).tolist())
        meshes.setdefault(key, []).append((vertices @ matrix.T + geometry.geom_pos[geom], faces))
    return [Part(node, *_joined(each), rgba) for (node, rgba), each in meshes.items()]


def visible_geoms(model: mujoco.MjModel) -> list[int]:
    """Return the geoms that MuJoCo's viewers show: groups 0 to 2, not fully transparent; all geoms if none is."""
    shown = [geom for geom in range(model.ngeom) if model.geom_group[geom] <= 2 and geom_rgba(model, geom)[3] > 0]
    return shown or list(range(model.ngeom))


def geom_rgba(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Return the colour ``[4]`` of a geom, 0 to 1: its own, else its material's, with the mean of the texture."""
    rgba, material = model.geom_rgba[geom], model.geom_matid[geom]
    if material < 0:
        return rgba
    color = (model.mat_rgba[material] if (rgba == _GREY).all() else rgba).copy()
    textures = np.atleast_1d(model.mat_texid[material])  # one for each role in MuJoCo 3.2 and newer
    texture = max(textures[[0, 1]] if len(textures) > 1 else textures)  # user data, colour
    if texture >= 0:
        start, channels = model.tex_adr[texture], model.tex_nchannel[texture]
        count = int(model.tex_width[texture]) * int(model.tex_height[texture])
        pixels = model.tex_data[start : start + count * channels].reshape(count, channels)
        color[:3] *= pixels.mean(0)[[0, 1, 2] if channels >= 3 else [0, 0, 0]] / 255
    return color


def geom_mesh(model: mujoco.MjModel, geom: int) -> Mesh:
    """Return vertices ``[V, 3]``, metres in the geom's frame, and faces ``[F, 3]`` of a geom.

    Edges have a vertex for each of their faces, so that normals that are averaged at vertices keep them sharp.

    Raises:
        ValueError: if MuJoCo has the type for decoration only.
    """
    kind, size, data = int(model.geom_type[geom]), model.geom_size[geom], int(model.geom_dataid[geom])
    if kind == _Geom.mjGEOM_PLANE:
        half = np.where(size[:2] > 0, size[:2], _ENDLESS)
        return np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [*half, 0], _quads(np.arange(4)[None])
    if kind == _Geom.mjGEOM_SPHERE:
        return sphere(size[[0, 0, 0]])
    if kind == _Geom.mjGEOM_ELLIPSOID:
        return sphere(size)
    if kind == _Geom.mjGEOM_CAPSULE:
        return sphere(size[[0, 0, 0]], stretch=size[1])
    if kind == _Geom.mjGEOM_CYLINDER:
        return _cylinder(size[0], size[1])
    if kind == _Geom.mjGEOM_BOX:
        return _box(size)
    if data >= 0 and kind in (int(_Geom.mjGEOM_MESH), int(_Geom.mjGEOM_SDF)):
        return _mesh(model, data)
    if kind == _Geom.mjGEOM_HFIELD:
        return _height_field(model, data)
    raise ValueError(f"Geom {model.geom(geom).name or geom} is of type {kind}, which has no shape to draw.")


def _quads(corners: np.ndarray) -> np.ndarray:
    """Split quadrilaterals ``[Q, 4]`` into triangles ``[2 Q, 3]``."""
    return np.concatenate((corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]))


def _grid(rows: int, columns: int) -> np.ndarray:
    """Return the quadrilaterals ``[(rows - 1) (columns - 1), 4]`` of a grid of vertices, row by row."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    return np.stack((corner, corner + 1, corner + columns + 1, corner + columns), axis=-1)


def sphere(radii: np.ndarray, stretch: float = 0.0) -> Mesh:
    """Return an ellipsoid of ``radii`` ``[3]``, or a capsule of half length ``stretch`` along z."""
    polar = np.linspace(0, np.pi, _RINGS + 1)
    rise = np.full(len(polar), stretch)
    rise[_RINGS // 2 + 1 :] *= -1
    if stretch:  # the equator twice, with the side in between
        middle = _RINGS // 2
        polar, rise = np.insert(polar, middle, polar[middle]), np.insert(rise, middle + 1, -stretch)
    angle = np.linspace(0, 2 * np.pi, _SIDES + 1)
    around = np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    flat = np.sin(polar)[:, None, None] * around * radii[:2]
    height = np.broadcast_to((np.cos(polar) * radii[2] + rise)[:, None, None], (*flat.shape[:2], 1))
    vertices = np.concatenate((flat, height), axis=-1).reshape(-1, 3)
    return vertices, _quads(_grid(len(polar), _SIDES + 1)[:, [0, 3, 2, 1]])


def _cylinder(radius: float, half: float) -> Mesh:
    angle = np.linspace(0, 2 * np.pi, _SIDES + 1)
    rim = np.stack((radius * np.cos(angle), radius * np.sin(angle), np.full_like(angle, half)), axis=-1)
    low = rim * [1, 1, -1]
    side = np.concatenate((low, rim)), _quads(_grid(2, _SIDES + 1))
    first = np.arange(1, _SIDES - 1)
    fan = np.stack((np.zeros_like(first), first, first + 1), axis=-1)
    return _joined([side, (rim[:-1], fan), (low[:-1], fan[:, ::-1])])


def _box(size: np.ndarray) -> Mesh:
    square = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], dtype=float)
    faces = []
    for axis in range(3):
        for sign in (1, -1):
            corners = np.roll(square * [1, 1, sign], axis + 1, axis=1)
            faces.append((corners * size, _quads(np.arange(4)[None, ::sign])))
    return _joined(faces)


def _mesh(model: mujoco.MjModel, mesh: int) -> Mesh:
    first, count, start = model.mesh_faceadr[mesh], model.mesh_facenum[mesh], model.mesh_vertadr[mesh]
    vertices = model.mesh_vert[start : start + model.mesh_vertnum[mesh]].astype(float)
    return _creased(vertices, model.mesh_face[first : first + count])


def _creased(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """Split the vertices of faces that meet at a sharp edge."""
    a, b, c = vertices[faces].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-300)
    # Corner i of face f is number 3 f + i. Each edge of a face leads from a corner to the next.
    corner = np.arange(faces.size).reshape(-1, 3)
    begins, ends = corner.ravel(), np.roll(corner, -1, axis=1).ravel()
    from_, to = faces.ravel()[begins], faces.ravel()[ends]
    order = np.lexsort((np.maximum(from_, to), np.minimum(from_, to)))
    one, other = order[:-1], order[1:]  # neighbours in this order may be the two sides of an edge
    shared = (from_[one] == to[other]) & (to[one] == from_[other])
    smooth = shared & (np.einsum("ei,ei->e", normals[one // 3], normals[other // 3]) > _CREASE)
    one, other = one[smooth], other[smooth]
    joined = np.stack((np.r_[begins[one], ends[one]], np.r_[ends[other], begins[other]]))
    links = coo_array((np.ones(joined.shape[1], dtype=bool), joined), shape=(faces.size, faces.size))
    count, which = connected_components(links, directed=False)
    original = np.empty(count, dtype=np.int64)
    original[which] = faces.ravel()
    return vertices[original], which.reshape(-1, 3)


def _height_field(model: mujoco.MjModel, field: int) -> Mesh:
    """Return a closed height field: surface, sides and bottom."""
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    start, (x, y, top, bottom) = model.hfield_adr[field], model.hfield_size[field]
    height = model.hfield_data[start : start + rows * columns].reshape(rows, columns) * top
    across, along = np.meshgrid(np.linspace(-x, x, columns), np.linspace(-y, y, rows))
    surface = np.stack((across, along, height), axis=-1)
    edge = np.concatenate((surface[0, :-1], surface[:-1, -1], surface[-1, :0:-1], surface[::-1, 0]))
    low = edge * [1, 1, 0] - [0, 0, bottom]
    corners = np.array([[-x, -y, -bottom], [-x, y, -bottom], [x, y, -bottom], [x, -y, -bottom]])
    sides = np.concatenate((low, edge)), _quads(_grid(2, len(edge)))
    return _joined(
        [(surface.reshape(-1, 3), _quads(_grid(rows, columns))), sides, (corners, _quads(np.arange(4)[None]))]
    )


def _joined(meshes: list[Mesh]) -> Mesh:
    """Join meshes to one."""
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in meshes[:-1]])
    faces = [each + start for start, (_, each) in zip(starts, meshes, strict=True)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(faces)
