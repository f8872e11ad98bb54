"""Where actuators and equality constraints act in a scene's graph: edge pairs, control slots, gears at nodes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_gn.scenes.scene import UnsupportedSceneError
from torchrl_gn.scenes.topology import EdgePair, Topology, named, offset

_TRANSMISSION, _WRAP, _OBJECT, _EQUALITY = mujoco.mjtTrn, mujoco.mjtWrap, mujoco.mjtObj, mujoco.mjtEq
_Disable = mujoco.mjtDisableBit
_Place = int | tuple[int, int]  # a joint, or two nodes


@dataclass(frozen=True, eq=False)
class Transmissions:
    """Edge pairs of a scene and what acts at them."""

    pairs: tuple[EdgePair, ...]  # [P] the joints', then those of actuators, then those of equality constraints
    action: np.ndarray  # [P, C] control in each slot, by index; -1 without
    gear: np.ndarray  # [P, C, 6] what a unit of the actuator's force exerts there, see find_transmissions
    frame: np.ndarray  # [P, C] node in whose frame the gear is a force and torque; -1 where it is another
    equality: np.ndarray  # [P] MuJoCo id of the pair's equality constraint, -1 without


def find_transmissions(model: mujoco.MjModel, graph: Topology) -> Transmissions:
    """Edge pairs and control slots of a model; UnsupportedSceneError if an actuator hides a state or has no place.

    A control acts at the pair of its joint; of every joint of a fixed tendon, with its gear times the coefficient; of
    consecutive nodes on a spatial tendon's path; of a slider-crank's two nodes; of the world and the node of a site or
    of an adhesive body; of both nodes with a refsite. Two nodes without joint get a pair of their own. The gear of a
    site is its force and torque about the node's origin in the node's frame, with a refsite those of the refsite's.
    """
    pairs = list(graph.pairs)
    slots: list[dict[int, tuple[np.ndarray, int]]] = [{} for _ in pairs]
    for actuator in range(len(model.actuator_trntype)):
        _refuse_hidden_states(model, actuator)
        kind = _TRANSMISSION(model.actuator_trntype[actuator])
        for place, exerted, node in _places(model, graph, actuator):
            at = place if isinstance(place, int) else _pair_between(pairs, place)
            if at == len(pairs):
                assert not isinstance(place, int)
                pairs.append(EdgePair(named(model, _OBJECT.mjOBJ_ACTUATOR, actuator), _plain(kind.name), *place))
                slots.append({})
            slots[at][actuator] = exerted, node
    if model.npluginstate:
        raise UnsupportedSceneError(
            f"Plugin {named(model, _OBJECT.mjOBJ_PLUGIN, 0)!r} has a state that body states do not show. Remove it."
        )
    constraints = list(_constraints(model, graph))
    equality = np.array([*[-1] * len(pairs), *(which for which, _ in constraints)], dtype=np.int64)
    pairs += [pair for _, pair in constraints]
    most = max(1, *map(len, slots)) if slots else 1
    action, frame = np.full((2, len(pairs), most), -1, dtype=np.int64)
    gear = np.zeros((len(pairs), most, 6))
    for pair, acting in enumerate(slots):
        for slot, actuator in enumerate(sorted(acting)):
            action[pair, slot] = actuator
            gear[pair, slot], frame[pair, slot] = acting[actuator]
    return Transmissions(tuple(pairs), action, gear, frame, equality)


def _refuse_hidden_states(model: mujoco.MjModel, actuator: int) -> None:
    label = f"Actuator {named(model, _OBJECT.mjOBJ_ACTUATOR, actuator)!r}"
    # MuJoCo before 3.11 has one control an actuator, and before 3.5 no delays.
    controls, history = getattr(model, "actuator_ctrlnum", None), getattr(model, "actuator_history", None)
    if controls is not None and controls[actuator] != 1:
        raise UnsupportedSceneError(f"{label} has {controls[actuator]} controls; a slot of an edge takes one.")
    delayed = history is not None and history[actuator, 0] > 0
    if model.actuator_dyntype[actuator] != mujoco.mjtDyn.mjDYN_NONE or delayed:
        raise UnsupportedSceneError(
            f"{label} has activation dynamics or a delay, a state that body states do not"
            " show. Use dyntype none and no delay."
        )


def _places(model: mujoco.MjModel, graph: Topology, actuator: int) -> Iterator[tuple[_Place, np.ndarray, int]]:
    """Joints and pairs of nodes at which an actuator acts, its gear there, and the gear's node; none if it is idle."""
    kind, gear = _TRANSMISSION(model.actuator_trntype[actuator]), model.actuator_gear[actuator]
    target, other = map(int, model.actuator_trnid[actuator])
    label = f"Actuator {named(model, _OBJECT.mjOBJ_ACTUATOR, actuator)!r}"
    nodes = graph.node_of_body
    match kind:
        case _TRANSMISSION.mjTRN_JOINT | _TRANSMISSION.mjTRN_JOINTINPARENT:
            yield target, gear, -1
        case _TRANSMISSION.mjTRN_TENDON:
            for place, factor in _tendon_places(model, graph, target):
                yield place, factor * gear, -1
        case _TRANSMISSION.mjTRN_SITE if other < 0:
            if node := int(nodes[model.site_bodyid[target]]):
                yield (0, node), _wrench(model, graph, target, gear), node
        case _TRANSMISSION.mjTRN_SITE | _TRANSMISSION.mjTRN_SLIDERCRANK:
            node, reference = (int(nodes[model.site_bodyid[site]]) for site in (target, other))
            ends = min(node, reference), max(node, reference)
            if node != reference and kind == _TRANSMISSION.mjTRN_SITE:
                yield ends, _wrench(model, graph, other, gear), reference
            elif node != reference:
                yield ends, gear, -1
        case _TRANSMISSION.mjTRN_BODY:
            if not nodes[target]:
                raise UnsupportedSceneError(
                    f"{label} acts on the contacts of a body fixed to the world, so on bodies that no edge can tell."
                    " Let it act on a moving body."
                )
            yield (0, int(nodes[target])), gear, -1
        case _:
            raise UnsupportedSceneError(
                f"{label} acts through a {_plain(kind.name)}, which no edge can represent. Remove it."
            )


def _tendon_places(model: mujoco.MjModel, graph: Topology, tendon: int) -> Iterator[tuple[_Place, float]]:
    """Joints of a fixed tendon with their coefficients, or consecutive nodes of a spatial one with factor 1."""
    first = int(model.tendon_adr[tendon])
    coefficients: dict[_Place, float] = {}
    previous = None
    for wrap in range(first, first + int(model.tendon_num[tendon])):
        kind, at = _WRAP(model.wrap_type[wrap]), int(model.wrap_objid[wrap])
        if kind == _WRAP.mjWRAP_JOINT:
            coefficients[at] = coefficients.get(at, 0.0) + float(model.wrap_prm[wrap])
            continue
        if kind == _WRAP.mjWRAP_PULLEY:
            previous = None
            continue
        node = int(graph.node_of_body[(model.site_bodyid if kind == _WRAP.mjWRAP_SITE else model.geom_bodyid)[at]])
        if previous is not None and node != previous:
            coefficients[min(previous, node), max(previous, node)] = 1.0
        previous = node
    yield from coefficients.items()


def _pair_between(pairs: list[EdgePair], nodes: tuple[int, int]) -> int:
    """Index of the first pair between two nodes, ``len(pairs)`` without."""
    return next((at for at, pair in enumerate(pairs) if {pair.first, pair.second} == set(nodes)), len(pairs))


def _wrench(model: mujoco.MjModel, graph: Topology, site: int, gear: np.ndarray) -> np.ndarray:
    """Force and torque ``[6]`` about the origin of a site's node, in its frame, of a gear in the site's frame."""
    _, point, quat = _in_node(model, graph, int(model.site_bodyid[site]), model.site_pos[site])
    orientation, force, torque = np.empty(4), np.empty(3), np.empty(3)
    mujoco.mju_mulQuat(orientation, quat, model.site_quat[site])
    mujoco.mju_rotVecQuat(force, gear[:3], orientation)
    mujoco.mju_rotVecQuat(torque, gear[3:], orientation)
    return np.concatenate((force, torque + np.cross(point, force)))


def _in_node(
    model: mujoco.MjModel, graph: Topology, body: int, point: np.ndarray
) -> tuple[int, np.ndarray, np.ndarray]:
    """Node of a body, a point ``[3]`` of the body in the node's frame, and the body's quaternion ``[4]`` there."""
    node, rotated = int(graph.node_of_body[body]), np.empty(3)
    pos, quat = offset(model, body, int(graph.body[node]))
    mujoco.mju_rotVecQuat(rotated, point, quat)
    return node, pos + rotated, quat


def _constraints(model: mujoco.MjModel, graph: Topology) -> Iterator[tuple[int, EdgePair]]:
    """Pairs of the active connect and weld constraints between two nodes."""
    if model.opt.disableflags & (_Disable.mjDSBL_EQUALITY | _Disable.mjDSBL_CONSTRAINT):
        return
    for equality in np.flatnonzero(model.eq_active0).tolist():
        kind = _EQUALITY(model.eq_type[equality])
        if kind in (_EQUALITY.mjEQ_CONNECT, _EQUALITY.mjEQ_WELD):
            first, second = sorted(node for node, _ in anchors(model, graph, equality))
            if first != second:
                yield (
                    equality,
                    EdgePair(named(model, _OBJECT.mjOBJ_EQUALITY, equality), _plain(kind.name), first, second),
                )


def anchors(model: mujoco.MjModel, graph: Topology, equality: int) -> list[tuple[int, np.ndarray]]:
    """Both nodes of a connect or weld constraint, and its anchors ``[3]`` in their frames, metres."""
    found, data = [], model.eq_data[equality]
    weld = model.eq_type[equality] == _EQUALITY.mjEQ_WELD
    for end, at in enumerate((int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality]))):
        if model.eq_objtype[equality] == _OBJECT.mjOBJ_SITE:
            body, point = int(model.site_bodyid[at]), model.site_pos[at]
        else:
            # A weld has one anchor, in the second body, and the second body's position in the first.
            body, point = at, data[3 * (end == (0 if weld else 1)) :][:3]
        found.append(_in_node(model, graph, body, point)[:2])
    return found


def _plain(name: str) -> str:
    """``"tendon"`` of ``mjTRN_TENDON``."""
    return name.split("_", 1)[1].lower()
