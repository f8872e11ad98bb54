"""Contact pairs: nodes whose geoms can touch, found at random configurations."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from torchrl_gn.scenes.collisions import colliding_geoms
from torchrl_gn.scenes.contact_points import SHAPES
from torchrl_gn.scenes.contact_shapes import Candidate, RoundedBox, candidates, rounded_box
from torchrl_gn.scenes.joint_ranges import bounded_joints, drawn_ranges
from torchrl_gn.scenes.topology import named, weld_roots

if TYPE_CHECKING:
    from torchrl_gn.scenes.scene import Scene

MOST_PAIRS = 24
MOST_CANDIDATES = 32  # of each pair
MOST_OF_ALL = 384  # candidates of all pairs
_MARGIN = 0.05  # metres: geoms that come closer than this can touch
_CONFIGURATIONS = 400
_ENOUGH = 100  # most configurations counted in which two geoms are near
_RARE = 0.15  # a geom's corners are left out if each is near in a smaller share of these
_GEOM, _JOINT = mujoco.mjtGeom, mujoco.mjtJoint


@dataclass(frozen=True, eq=False)
class ContactPairs:
    """Pairs of nodes that can touch, and their candidates: segments on one node, boxes on the other.

    The nearest candidate gives a pair's distance. Pairs with the most candidates come first; within a pair, candidates
    that are near most often.
    """

    nodes: np.ndarray  # [P, 2] nodes of each pair
    pair: np.ndarray  # [C] pair of each candidate
    segment_node: np.ndarray  # [C] node that the segment is on
    box_node: np.ndarray  # [C] node that the box is on
    start: np.ndarray  # [C, 3] one end of the segment in its node's frame, metres
    direction: np.ndarray  # [C, 3] from the start to the other end; 0 for a point
    center: np.ndarray  # [C, 3] centre of the box in its node's frame, metres
    rotation: np.ndarray  # [C, 3, 3] from the box's frame to its node's
    half_size: np.ndarray  # [C, 3] half sizes of the box, metres
    radius: np.ndarray  # [C, 2] rounding of segment and box, metres
    has_ends: np.ndarray  # [C] bool, True if the segment's ends are candidates too
    left_out: int = 0  # number of less frequent pairs that are left out
    ignored: tuple[str, ...] = ()  # names of geoms that can be touched but have no distance (height fields, ...)

    def __str__(self) -> str:
        return f"{len(self.nodes)} contact pairs, {len(self.pair)} candidates"


def find_contact_pairs(scene: Scene) -> ContactPairs:
    """Find the nodes that can touch.

    Two nodes can touch if MuJoCo lets two of their geoms collide, and these come within 5 cm in one of 400 random
    configurations within the joints' limits. Most configurations put freely moving bodies near other geoms. Contacts of
    :class:`~torchrl_gn.scenes.contact_points.ContactPoints` are left out. The same scene always gives the same pairs.
    """
    model, data = scene.model, mujoco.MjData(scene.model)
    node_of_geom = _node_of_geom(scene)
    mujoco.mj_kinematics(model, data)
    boxes = [rounded_box(model, data, geom, int(scene.body[node])) for geom, node in enumerate(node_of_geom)]
    possible = possible_contacts(scene)
    ignored = {geom for pair in possible for geom in pair if boxes[geom] is None}
    pairs = np.array([pair for pair in possible if not ignored & set(pair)], dtype=np.int64).reshape(-1, 2)
    found: dict[tuple[int, int], list[Candidate]] = {}
    for first, second in pairs.tolist():
        axes = _planar_axes(scene, data, int(node_of_geom[first]), int(node_of_geom[second]))
        found[first, second] = candidates(_required(boxes[first]), _required(boxes[second]), axes)
    seen = _count_near(scene, node_of_geom, pairs, found)
    near_candidates: dict[tuple[int, int], list[tuple[int, Candidate]]] = {}
    every: dict[tuple[int, int], list[tuple[int, Candidate]]] = {}
    often: dict[tuple[int, int], int] = {}
    for geoms, (near, counts) in seen.items():
        a, b = (int(node_of_geom[geom]) for geom in geoms)
        sides = np.array([each.on_second for each in found[geoms]])
        often_near = [bool((counts[sides == side] >= _RARE * near).any()) for side in (False, True)]
        counted = [(int(n), each) for n, each in zip(counts, found[geoms], strict=True)]
        if a > b:  # the lower node first
            a, b, counted = b, a, [(count, each._replace(on_second=not each.on_second)) for count, each in counted]
            often_near.reverse()
        every.setdefault((a, b), []).extend(counted)
        near_candidates.setdefault((a, b), []).extend(each for each in counted if often_near[each[1].on_second])
        often[a, b] = often.get((a, b), 0) + near
    # Bars that cross meet far from all corners; a pair needs some candidate.
    near_candidates = {nodes: some or every[nodes] for nodes, some in near_candidates.items()}
    ranked = sorted(sorted(near_candidates), key=lambda nodes: -often[nodes])[:MOST_PAIRS]
    lists = [[each for _, each in sorted(near_candidates[nodes], key=lambda each: -each[0])] for nodes in ranked]
    lists = [each[:MOST_CANDIDATES] for each in lists]
    fit = int((np.cumsum([len(each) for each in lists]) <= MOST_OF_ALL).sum())
    chosen = sorted(zip(ranked[:fit], lists[:fit], strict=True), key=lambda each: -len(each[1]))
    names = tuple(named(model, mujoco.mjtObj.mjOBJ_GEOM, geom) for geom in sorted(ignored))
    return _arrays([nodes for nodes, _ in chosen], [each for _, each in chosen], len(near_candidates) - fit, names)


def _arrays(
    nodes: list[tuple[int, int]], lists: list[list[Candidate]], left_out: int, ignored: tuple[str, ...]
) -> ContactPairs:
    rows = [(pair, candidate) for pair, of_pair in enumerate(lists) for candidate in of_pair]
    pair = np.array([pair for pair, _ in rows], dtype=np.int64)
    node_pairs = np.array(nodes, dtype=np.int64).reshape(-1, 2)
    second = np.array([candidate.on_second for _, candidate in rows], dtype=np.int64)

    def column(values: list, *shape: int) -> np.ndarray:
        return np.array(values, dtype=np.float64).reshape(len(rows), *shape)

    return ContactPairs(
        nodes=node_pairs,
        pair=pair,
        segment_node=node_pairs[pair, second],
        box_node=node_pairs[pair, 1 - second],
        start=column([candidate.start for _, candidate in rows], 3),
        direction=column([candidate.direction for _, candidate in rows], 3),
        center=column([candidate.box.center for _, candidate in rows], 3),
        rotation=column([candidate.box.rotation for _, candidate in rows], 3, 3),
        half_size=column([candidate.box.half for _, candidate in rows], 3),
        radius=column([(candidate.radius, candidate.box.radius) for _, candidate in rows], 2),
        has_ends=np.array([candidate.has_ends for _, candidate in rows], dtype=bool),
        left_out=left_out,
        ignored=ignored,
    )


def _required(box: RoundedBox | None) -> RoundedBox:
    assert box is not None
    return box


def _node_of_geom(scene: Scene) -> np.ndarray:
    return np.searchsorted(scene.body, weld_roots(scene.model))[scene.model.geom_bodyid]


def possible_contacts(scene: Scene) -> list[tuple[int, int]]:
    """List pairs of geoms on different nodes that MuJoCo lets collide, without those of contact points."""
    node_of_geom = _node_of_geom(scene)
    pairs = ((first, second) for second, first in np.argwhere(np.tril(colliding_geoms(scene.model))).tolist())
    return [
        pair
        for pair in pairs
        if node_of_geom[pair[0]] != node_of_geom[pair[1]] and not _has_contact_points(scene, *pair)
    ]


def bodies_can_touch(scene: Scene) -> bool:
    """Return True if MuJoCo lets geoms on different nodes collide, the world's included."""
    return scene.contact_points is not None or len(possible_contacts(scene)) > 0


def _has_contact_points(scene: Scene, first: int, second: int) -> bool:
    """Return True if one geom is the plane of the contact points and the other has such points."""
    points, kind = scene.contact_points, scene.model.geom_type
    return points is not None and any(
        plane == points.plane and int(kind[other]) in SHAPES for plane, other in ((first, second), (second, first))
    )


def _planar_axes(scene: Scene, data: mujoco.MjData, *nodes: int) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return the normal of the plane in which both nodes move, in each node's frame; None if they move in space."""
    moves = np.any(scene.movable[list(nodes)], axis=0)
    for axis in range(3):
        across = [index for index in range(3) if index != axis]
        if not moves[axis] and not moves[[3 + index for index in across]].any():
            one, other = (data.xmat[scene.body[node]].reshape(3, 3)[axis].copy() for node in nodes)
            return one, other
    return None, None


def _count_near(
    scene: Scene, nodes: np.ndarray, pairs: np.ndarray, found: dict[tuple[int, int], list[Candidate]]
) -> dict[tuple[int, int], tuple[int, np.ndarray]]:
    """Count how often two geoms, and each of their candidates, are near; geoms that never are have no entry."""
    model, data = scene.model, mujoco.MjData(scene.model)
    seen: dict[tuple[int, int], tuple[int, np.ndarray]] = {}
    reach = np.where(model.geom_type == _GEOM.mjGEOM_PLANE, np.inf, model.geom_rbound)
    counts = np.zeros(len(pairs), dtype=np.int64)
    for _ in _configurations(model, data) if len(pairs) else ():
        away = np.linalg.norm(data.geom_xpos[pairs[:, 0]] - data.geom_xpos[pairs[:, 1]], axis=1)
        close = (away - reach[pairs].sum(1) < _MARGIN) & (counts < _ENOUGH)
        for index in np.flatnonzero(close):
            first, second = pairs[index].tolist()
            if mujoco.mj_geomDistance(model, data, first, second, _MARGIN, None) >= _MARGIN:
                continue
            counts[index] += 1
            bodies = [int(scene.body[nodes[geom]]) for geom in (first, second)]
            near = np.array([_is_near(data, each, *bodies) for each in found[first, second]])
            _, before = seen.get((first, second), (0, 0))
            seen[first, second] = int(counts[index]), before + near.astype(np.int64)
    return seen


def _is_near(data: mujoco.MjData, candidate: Candidate, first: int, second: int) -> bool:
    """Return True if a candidate's point is near its box; a segment always counts as near."""
    if candidate.direction.any():
        return True
    body, other = (second, first) if candidate.on_second else (first, second)
    world = data.xpos[body] + data.xmat[body].reshape(3, 3) @ candidate.start
    local = data.xmat[other].reshape(3, 3).T @ (world - data.xpos[other])
    return bool(candidate.box.distance(local) - candidate.radius < _MARGIN)


def _configurations(model: mujoco.MjModel, data: mujoco.MjData) -> Iterator[None]:
    """Set ``data`` to random configurations within the joints' limits, kinematics done; yield after each."""
    rng, ranges = np.random.default_rng(0), drawn_ranges(model, model.qpos0)
    floating, colliding = _floating(model), colliding_geoms(model)
    for _ in range(_CONFIGURATIONS):
        _random_joints(model, data, ranges, rng)
        mujoco.mj_kinematics(model, data)
        for body in rng.permutation(np.array(list(floating), dtype=np.int64)).tolist():
            if rng.random() < 0.8:
                _move_near(model, data, rng, body, floating[body], colliding)
                mujoco.mj_kinematics(model, data)
        yield


def _random_joints(model: mujoco.MjModel, data: mujoco.MjData, ranges: np.ndarray, rng: np.random.Generator) -> None:
    extent = float(model.stat.extent)
    for joint in range(model.njnt):
        kind, start = _JOINT(model.jnt_type[joint]), int(model.jnt_qposadr[joint])
        if kind in (_JOINT.mjJNT_FREE, _JOINT.mjJNT_BALL):
            if kind == _JOINT.mjJNT_FREE:
                data.qpos[start : start + 3] = model.stat.center + rng.uniform(-extent, extent, 3)
                start += 3
            quat = rng.normal(size=4)
            data.qpos[start : start + 4] = quat / np.linalg.norm(quat)
            continue
        data.qpos[start] = rng.uniform(*ranges[joint])


def _floating(model: mujoco.MjModel) -> dict[int, list[int]]:
    """Find bodies attached to the world by a free joint or slides without limits, and these joints."""
    joints: dict[int, list[int]] = {}
    roots, bounded = weld_roots(model), bounded_joints(model)
    for joint in range(model.njnt):
        body, kind = int(model.jnt_bodyid[joint]), model.jnt_type[joint]
        free = kind == _JOINT.mjJNT_FREE or (kind == _JOINT.mjJNT_SLIDE and not bounded[joint])
        if free and roots[model.body_parentid[body]] == 0:
            joints.setdefault(body, []).append(joint)
    return joints


def _move_near(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    rng: np.random.Generator,
    body: int,
    joints: list[int],
    colliding: np.ndarray,
) -> None:
    """Move a floating body so that a random geom of its tree is near a random geom that it can touch."""
    same_tree = model.body_rootid[model.geom_bodyid] == model.body_rootid[body]
    meeting = colliding & same_tree[:, None] & ~same_tree
    if not meeting.any():
        return
    geom = int(rng.choice(np.flatnonzero(meeting.any(1))))
    other = int(rng.choice(np.flatnonzero(meeting[geom])))
    if model.geom_type[other] == _GEOM.mjGEOM_PLANE:
        point, axis, side = np.append(rng.normal(size=2), 0), 2, 1
    else:  # on a side of its bounding box, drawn by area
        middle, half = model.geom_aabb[other, :3], model.geom_aabb[other, 3:]
        area = half[[1, 0, 0]] * half[[2, 2, 1]]
        area = np.ones(3) if not area.any() else area  # a line or point has none
        axis, side = rng.choice(3, p=area / area.sum()), rng.choice([-1, 1])
        point = middle + rng.uniform(-half, half)
        point[axis] = middle[axis] + side * half[axis]
    point[axis] += side * rng.uniform(0.2, 1) * (model.geom_rbound[geom] + _MARGIN)
    shift = data.geom_xpos[other] + data.geom_xmat[other].reshape(3, 3) @ point - data.geom_xpos[geom]
    for joint in joints:
        start = int(model.jnt_qposadr[joint])
        if model.jnt_type[joint] == _JOINT.mjJNT_FREE:
            data.qpos[start : start + 3] += shift
        else:
            data.qpos[start] += data.xaxis[joint] @ shift
