"""Lines along which spatial tendons and slider-cranks pull: their pieces between nodes, and the joints they move."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from torchrl_gn.scenes.topology import Topology, in_node, site_in_node

_WRAP = mujoco.mjtWrap


class Piece(NamedTuple):
    """Part of a tendon from one site to the next, perhaps around a geom."""

    first: int  # site
    second: int
    divisor: float  # of the preceding pulley
    geom: int = -1  # wrapping geom, -1 without
    side: int = -1  # site that selects the side of the geom, -1 without


def tendon_pieces(model: mujoco.MjModel, tendon: int) -> list[Piece]:
    """List the pieces of a spatial tendon's path; none for a fixed tendon."""
    pieces, previous, geom, side, divisor = [], None, -1, -1, 1.0
    start = int(model.tendon_adr[tendon])
    for wrap in range(start, start + int(model.tendon_num[tendon])):
        at, number = int(model.wrap_objid[wrap]), float(model.wrap_prm[wrap])
        match _WRAP(model.wrap_type[wrap]):
            case _WRAP.mjWRAP_PULLEY:
                previous, divisor = None, number
            case _WRAP.mjWRAP_SPHERE | _WRAP.mjWRAP_CYLINDER:
                geom, side = at, round(number)
            case _WRAP.mjWRAP_SITE:
                if previous is not None:
                    pieces.append(Piece(previous, at, divisor, geom, side))
                previous, geom, side = at, -1, -1
    return pieces


def tendon_ends(model: mujoco.MjModel, graph: Topology, tendon: int) -> list[tuple[int, int]]:
    """List the node pairs between which a spatial tendon pulls; a piece around a geom gives two, both with its node."""
    node_pairs = []
    for piece in tendon_pieces(model, tendon):
        nodes = [int(graph.node_of_body[model.site_bodyid[site]]) for site in (piece.first, piece.second)]
        if piece.geom >= 0:
            nodes.insert(1, int(graph.node_of_body[model.geom_bodyid[piece.geom]]))
        node_pairs += zip(nodes, nodes[1:], strict=False)
    return node_pairs


def passes_inside(model: mujoco.MjModel, piece: Piece) -> bool:
    """Return True if a piece's side site is or may be inside its geom, where MuJoCo finds the path iteratively."""
    if piece.side < 0:
        return False
    body = int(model.geom_bodyid[piece.geom])
    if model.site_bodyid[piece.side] != body:
        return True
    position, back, away = np.empty(3), np.empty(4), model.site_pos[piece.side] - model.geom_pos[piece.geom]
    mujoco.mju_negQuat(back, model.geom_quat[piece.geom])
    mujoco.mju_rotVecQuat(position, away, back)
    is_sphere = model.geom_type[piece.geom] == int(mujoco.mjtGeom.mjGEOM_SPHERE)
    return bool(np.linalg.norm(position if is_sphere else position[:2]) < model.geom_size[piece.geom, 0])


def known_tendon(model: mujoco.MjModel, tendon: int) -> bool:
    """Return True if the length of a spatial tendon follows from body states here."""
    pieces = tendon_pieces(model, tendon)
    return bool(pieces) and not any(passes_inside(model, piece) for piece in pieces)


def signs(graph: Topology, ends: Sequence[tuple[int, int]]) -> np.ndarray:
    """Return ``[J, S]``: 1 if a joint moves only the second of two nodes, -1 if only the first, else 0."""
    below = np.zeros((len(graph.body), len(graph.body)), dtype=int)  # [N, N] 1 where the column is the row or above it
    for node, parent in enumerate(graph.parent.tolist()):
        below[node] = below[parent] if parent >= 0 else 0
        below[node, node] = 1
    children = [pair.second for pair in graph.pairs]
    first, second = np.array(ends, dtype=int).reshape(-1, 2).T
    return (below[second] - below[first])[:, children].T


def moved_joints(graph: Topology, ends: Sequence[tuple[int, int]]) -> list[int]:
    """Return the joints that move exactly one of the two nodes of some entry of ``ends``."""
    return np.flatnonzero(signs(graph, ends).any(1)).tolist()


def geom_in_node(model: mujoco.MjModel, graph: Topology, geom: int) -> tuple[int, np.ndarray, np.ndarray]:
    """Return a geom's node, and its position ``[3]`` and axes ``[3, 3]`` in the node's frame."""
    node, position, quat = in_node(model, graph, int(model.geom_bodyid[geom]), model.geom_pos[geom])
    orientation = np.empty(4)
    mujoco.mju_mulQuat(orientation, quat, model.geom_quat[geom])
    return node, position, rotation(orientation)


def site_frame(model: mujoco.MjModel, graph: Topology, site: int) -> tuple[int, np.ndarray, np.ndarray]:
    """Return a site's node, and its position ``[3]`` and axes ``[3, 3]`` in the node's frame."""
    node, position, quat = site_in_node(model, graph, site)
    return node, position, rotation(quat)


def rotation(quat: np.ndarray) -> np.ndarray:
    """Return the matrix ``[3, 3]`` of a quaternion."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)
