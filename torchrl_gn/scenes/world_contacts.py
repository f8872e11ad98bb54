"""Contacts with the world: points of bodies, and the surfaces that each can touch."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from torchrl_gn.scenes.collisions import colliding_geoms
from torchrl_gn.scenes.contact_points import SLOTS
from torchrl_gn.scenes.invariance import surface_velocities
from torchrl_gn.scenes.surfaces import KINDS, MOST_SURFACES, Surface, find_surface, hull_vertices
from torchrl_gn.scenes.topology import named, weld_roots

if TYPE_CHECKING:
    from torchrl_gn.scenes.scene import Scene

_GEOM = mujoco.mjtGeom
MOST_POINTS = 8  # per node
MOST_OF_ALL = 256  # points of all nodes
_AT_SURFACE = 0.01  # metres: largest distance at which a force may set in for the features of one plane


@dataclass(frozen=True, eq=False)
class WorldContacts:
    """Points of bodies, the surfaces that they can touch, and the parameters of their contacts.

    A point is a sphere, or the point of an ellipsoid, a disc or a rounded segment that is nearest to the surface.
    """

    surfaces: tuple[Surface, ...]  # [S] sorted by kind
    geom: np.ndarray  # [C] geom that each point is on
    node: np.ndarray  # [C] node of each point
    slot: np.ndarray  # [C] index among the points of its node, below 8
    # [C, 16] centre 3 in the node's frame, radius 1, half axes 9 of an ellipsoid about the centre (columns of a matrix,
    # row by row), vector 3 from the centre to the other end of a segment; metres. Segments come last
    points: np.ndarray
    velocity: np.ndarray  # [C, 6] of the geom's surface at the centre, linear and angular, node's frame
    touches: np.ndarray  # [C, S] bool, True if the point can touch the surface
    pairs: np.ndarray  # [C, S, 2] coefficient of sliding friction, distance at which the force sets in [m]
    reduced: tuple[str, ...] = ()  # names of nodes with points left out
    ignored: tuple[str, ...] = ()  # names of geoms that can be touched but are not in surfaces

    @property
    def kinds(self) -> list[str]:
        """Kinds ``[S]`` of the surfaces."""
        return [surface.kind for surface in self.surfaces]

    @property
    def constants(self) -> np.ndarray:
        """Constants ``[S, 22]`` of the surfaces."""
        return np.array([surface.constants for surface in self.surfaces]).reshape(-1, 22)


def find_world_contacts(scene: Scene) -> WorldContacts:
    """Find the points of a scene's bodies that can touch surfaces of the world.

    A fixed body other than the world is not a surface to the bodies of its own tree: a robot does not touch its base.
    Planes and height fields of that body are ground, which everything can touch, as in scenes within a body. Bodies
    that slide along two axes or more, such as a puck on a table, touch all that carries them.
    """
    model, data = scene.model, mujoco.MjData(scene.model)
    mujoco.mj_kinematics(model, data)
    body = model.geom_bodyid
    node, tree = np.searchsorted(scene.body, weld_roots(model))[body], model.body_rootid[body]
    is_ground = np.isin(model.geom_type, (int(_GEOM.mjGEOM_PLANE), int(_GEOM.mjGEOM_HFIELD)))
    open_to_all = is_ground | (body == 0) | _roams(scene)[node]
    colliding = colliding_geoms(model) & ((tree[:, None] != tree) | open_to_all | open_to_all[:, None])
    moving = np.flatnonzero(node > 0)
    touched = [int(geom) for geom in np.flatnonzero(node == 0) if colliding[geom, moving].any()]
    surfaces_found = [surface for geom in touched if (surface := find_surface(model, data, geom)) is not None]
    # Unbounded surfaces first, then the largest.
    size = np.where(is_ground, np.inf, model.geom_rbound)
    largest = sorted(surfaces_found, key=lambda surface: -size[surface.geom])[:MOST_SURFACES]
    surfaces = sorted(largest, key=lambda surface: (KINDS.index(surface.kind), surface.geom))
    geoms = np.array([surface.geom for surface in surfaces], dtype=np.int64)
    boxes = np.array([surface.kind == "box" for surface in surfaces], dtype=bool)
    rows = [
        (int(geom), int(node[geom]), _in_node(model, data, int(geom), int(scene.body[node[geom]]), point))
        for geom in (moving[colliding[np.ix_(moving, geoms)].any(1)] if len(geoms) else ())
        for point in _points(model, int(geom), bool(boxes.any()))
    ]
    chosen, slots, reduced = _chosen(rows)
    node_of_geom = {geom: node for geom, node, _ in rows}
    reduced = sorted({*reduced, *(node for geom, node in node_of_geom.items() if _is_rounder(model, geom))})
    chosen_geoms = np.array([geom for geom, _, _ in chosen], dtype=np.int64)
    points = np.array([point for _, _, point in chosen]).reshape(-1, 16)
    touches = colliding[np.ix_(chosen_geoms, geoms)] if len(chosen) else np.zeros((0, len(geoms)), dtype=bool)
    # Segments are for boxes alone: other surfaces need only their ends, which are points of their own.
    touches &= ~points[:, 13:].any(1, keepdims=True) | boxes
    numbers = ContactNumbers(model)
    pairs = np.array([[numbers(one, other) for other in geoms.tolist()] for one in chosen_geoms.tolist()])
    nodes = np.array([node for _, node, _ in chosen], dtype=np.int64)
    return WorldContacts(
        surfaces=tuple(surfaces),
        geom=chosen_geoms,
        node=nodes,
        slot=slots,
        points=points,
        velocity=_velocities(scene, data, chosen_geoms, nodes, points),
        touches=touches,
        pairs=pairs.reshape(len(chosen), len(geoms), 2),
        reduced=tuple(scene.node_names[one] for one in reduced),
        ignored=tuple(named(model, mujoco.mjtObj.mjOBJ_GEOM, geom) for geom in touched if geom not in geoms),
    )


def _roams(scene: Scene) -> np.ndarray:
    """Find nodes ``[N]``, bool, of trees whose root slides along two axes or more."""
    model, roams = scene.model, np.zeros(scene.num_nodes, dtype=bool)
    slides = np.bincount(model.jnt_bodyid[model.jnt_type == int(mujoco.mjtJoint.mjJNT_SLIDE)], minlength=model.nbody)
    for node in range(1, scene.num_nodes):  # parents come first
        above = int(scene.parent[node])
        roams[node] = roams[above] if above else slides[scene.body[node]] > 1
    return roams


def shown_by_plane(scene: Scene) -> bool:
    """Return True if ``scene.contact_points`` covers all contacts with the world.

    It covers spheres and capsules on one plane whose surface does not move, with up to four points per node, whose
    forces set in within 1 cm of the plane.
    """
    contacts, points = scene.world_contacts, scene.contact_points
    if not len(contacts.node):
        return True
    known = [] if points is None else [points.plane]
    simple = np.isin(scene.model.geom_type[contacts.geom], (int(_GEOM.mjGEOM_SPHERE), int(_GEOM.mjGEOM_CAPSULE)))
    still = not contacts.constants[:, 16:].any() and not contacts.velocity.any()
    few = contacts.slot.max() < SLOTS and not contacts.reduced
    at_plane = few and still and bool((np.abs(contacts.pairs[..., 1]) <= _AT_SURFACE).all())
    return [surface.geom for surface in contacts.surfaces] == known and bool(simple.all()) and at_plane


_Row = tuple[int, int, np.ndarray]  # geom, node, point


def _chosen(rows: list[_Row]) -> tuple[list[_Row], np.ndarray, list[int]]:
    """Choose at most 8 points per node and 256 in all, far apart; return them, their slots and nodes that lack some."""
    nodes = np.array([node for _, node, _ in rows], dtype=np.int64)
    counts = np.bincount(nodes)
    limits = range(MOST_POINTS, 1, -1)
    most = next((limit for limit in limits if np.minimum(counts, limit).sum() <= MOST_OF_ALL), 1)
    chosen: list[tuple[int, _Row]] = []
    for node in np.unique(nodes):
        own = [row for row in rows if row[1] == node]
        points = np.array([point for _, _, point in own])
        middle = points[:, :3] + points[:, 13:] / 2
        chosen += enumerate(own[index] for index in _outermost(middle, points[:, 3], most))
    chosen.sort(key=lambda each: each[1][2][13:].any())
    slots = np.array([slot for slot, _ in chosen], dtype=np.int64)
    return [row for _, row in chosen], slots, np.flatnonzero(counts > most).tolist()


def _outermost(points: np.ndarray, radius: np.ndarray, count: int) -> list[int]:
    """Return ascending indices of at most ``count`` spheres: those that reach farthest in some direction, then any.

    Distances are rounded before they are compared, so that all variants of a scene choose equivalent points alike.
    """
    directions = np.array(sorted(itertools.product((-1, 0, 1), repeat=3), key=lambda each: -np.abs(each).sum())[:-1])
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    farthest = (directions @ points.T + radius).round(9).argmax(1)
    return sorted(list(dict.fromkeys([*farthest.tolist(), *range(len(points))]))[:count])


def _points(model: mujoco.MjModel, geom: int, has_boxes: bool) -> list[np.ndarray]:
    """Return a geom's points ``[16]`` in its frame; for boxes also a capsule's side, which may touch their edges."""
    size, none = model.geom_size[geom], np.zeros(3)

    def sphere(center: ArrayLike, radius: float = 0.0, axes: ArrayLike = none, segment: ArrayLike = none) -> np.ndarray:
        return np.concatenate((center, [radius], np.diag(axes).ravel(), segment))

    match mujoco.mjtGeom(model.geom_type[geom]):
        case _GEOM.mjGEOM_SPHERE:
            return [sphere(none, size[0])]
        case _GEOM.mjGEOM_CAPSULE:
            end = np.array([0, 0, size[1]])
            side = [sphere(-end, size[0], segment=2 * end)] * has_boxes
            return [sphere(end, size[0]), sphere(-end, size[0]), *side]
        case _GEOM.mjGEOM_BOX:
            return [sphere(np.array(signs) * size) for signs in itertools.product((1, -1), repeat=3)]
        case _GEOM.mjGEOM_CYLINDER:
            return [sphere((0, 0, side * size[1]), axes=(size[0], size[0], 0)) for side in (1, -1)]
        case _GEOM.mjGEOM_ELLIPSOID:
            return [sphere(none, axes=size)]
        case _GEOM.mjGEOM_MESH if (vertices := hull_vertices(model, int(model.geom_dataid[geom]))) is not None:
            return [sphere(vertices[index]) for index in _outermost(vertices, np.zeros(len(vertices)), MOST_POINTS)]
    return []


def _is_rounder(model: mujoco.MjModel, geom: int) -> bool:
    """Return True if a geom is a mesh whose hull has more corners than a node has points."""
    if model.geom_type[geom] != int(_GEOM.mjGEOM_MESH):
        return False
    vertices = hull_vertices(model, int(model.geom_dataid[geom]))
    return vertices is not None and len(vertices) > MOST_POINTS


def _in_node(model: mujoco.MjModel, data: mujoco.MjData, geom: int, root: int, point: np.ndarray) -> np.ndarray:
    """Transform a point ``[16]`` from a geom's frame to the frame of its node's root body."""
    frame = data.xmat[root].reshape(3, 3)
    turn = frame.T @ data.geom_xmat[geom].reshape(3, 3)
    center = frame.T @ (data.geom_xpos[geom] - data.xpos[root]) + turn @ point[:3]
    return np.concatenate((center, point[3:4], (turn @ point[4:13].reshape(3, 3)).ravel(), turn @ point[13:]))


def _velocities(
    scene: Scene, data: mujoco.MjData, geoms: np.ndarray, nodes: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Return velocities ``[C, 6]`` of geoms' surfaces at the points' centres, linear and angular, nodes' frames."""
    geom_velocities, velocities = surface_velocities(scene.model), np.zeros((len(geoms), 6))
    for index, (geom, node) in enumerate(zip(geoms.tolist(), nodes.tolist(), strict=True)):
        root = int(scene.body[node])
        frame = data.xmat[root].reshape(3, 3)
        turn = frame.T @ data.geom_xmat[geom].reshape(3, 3)
        center = frame.T @ (data.geom_xpos[geom] - data.xpos[root])
        linear, angular = turn @ geom_velocities[geom, :3], turn @ geom_velocities[geom, 3:]
        velocities[index] = *(linear + np.cross(angular, points[index, :3] - center)), *angular
    return velocities


class ContactNumbers:
    """MuJoCo's friction and distance for the contact of two geoms."""

    def __init__(self, model: mujoco.MjModel) -> None:
        geom_pairs = zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
        self._model, self._pairs = model, {frozenset(pair): index for index, pair in enumerate(geom_pairs)}

    def __call__(self, first: int, second: int) -> tuple[float, float]:
        """Return the coefficient of sliding friction, and the distance at which the force sets in, metres."""
        model, both = self._model, [first, second]
        sums, gaps, pair_gaps = _margin_rule()
        if (pair := self._pairs.get(frozenset(both))) is not None:
            slides, friction = model.pair_dim[pair] > 1, model.pair_friction[pair, 0]
            margin, less = model.pair_margin[pair], pair_gaps * model.pair_gap[pair]
        else:
            priority = model.geom_priority[both]
            leading = np.array(both)[priority == priority.max()]
            slides, friction = model.geom_condim[leading].max() > 1, model.geom_friction[leading, 0].max()
            margin, gap = (
                (each[both].sum() if sums else each[both].max()) for each in (model.geom_margin, model.geom_gap)
            )
            less = gaps * gap
        if model.opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_OVERRIDE):
            friction, margin = model.opt.o_friction[0], model.opt.o_margin
        return float(friction) if slides else 0.0, float(margin - less)


@lru_cache
def _margin_rule() -> tuple[bool, bool, bool]:
    """Measure how this version of MuJoCo combines margins and gaps.

    Returns whether it adds the margins of two geoms (else it takes the larger), and whether gaps count for geoms and
    for explicit pairs. Where gaps count, in older versions, a contact's force sets in ``gap`` below the margin; in
    later ones the gap only adds contacts without force.
    """
    ball = '<body pos="0 0 {}"><freejoint/><geom name="{}" size=".1" margin="{}" gap="{}"/></body>'
    text = f"<mujoco><worldbody>{ball.format(0, 'a', 0.3, 0.1)}{ball.format(0.1, 'b', 0.2, 0.1)}</worldbody>"
    margins = []
    for pair in ("", '<contact><pair geom1="a" geom2="b" margin=".3" gap=".1"/></contact>'):
        model = mujoco.MjModel.from_xml_string(f"{text}{pair}</mujoco>")
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        margins.append(round(float(data.contact.includemargin[0]), 6))
    return margins[0] >= 0.4, margins[0] not in (0.5, 0.3), margins[1] < 0.3
