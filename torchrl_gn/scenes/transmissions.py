"""Edge pairs, control slots and gears of actuators and equality constraints in a scene's graph."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_gn.scenes.constraints import active_constraints, joined_frames, joins_bodies
from torchrl_gn.scenes.lines import moved_joints, tendon_ends
from torchrl_gn.scenes.scene import UnsupportedSceneError
from torchrl_gn.scenes.topology import EdgePair, Topology, named, site_in_node

_TRANSMISSION, _WRAP, _OBJECT, _EQUALITY = mujoco.mjtTrn, mujoco.mjtWrap, mujoco.mjtObj, mujoco.mjtEq
_Place = int | tuple[int, int]  # a joint, or two nodes


@dataclass(frozen=True, eq=False)
class Transmissions:
    """Edge pairs of a scene, and the actuators and constraints that act at them."""

    pairs: tuple[EdgePair, ...]  # [P] of joints, then of actuators, then of equality constraints
    action: np.ndarray  # [P, C] index of the control in each slot, -1 without
    gear: np.ndarray  # [P, C, 6] effect of a unit of actuator force there, see find_transmissions
    frame: np.ndarray  # [P, C] node in whose frame the gear is a force and torque; -1 if it is not
    equality: np.ndarray  # [P] MuJoCo id of the pair's equality constraint, -1 without


def find_transmissions(model: mujoco.MjModel, graph: Topology) -> Transmissions:
    """Find the edge pairs and control slots of a model.

    The transmission sets the pairs at which a control acts:

    * joint: the joint's pair;
    * fixed tendon: the pairs of its joints, with gear times coefficient;
    * spatial tendon or slider-crank: the pairs of all joints that it moves;
    * site or adhesive body: the pair of the world and the node;
    * site with a refsite: the pair of both nodes.

    Two nodes without a joint get a pair of their own. A site's gear is its force and torque about the node's origin in
    the node's frame; with a refsite, about the origin and in the frame of the refsite's node.

    Raises:
        UnsupportedSceneError: if an actuator or plugin has a hidden state, or no edge can represent an actuator.
    """
    pairs = list(graph.pairs)
    slots: list[dict[int, tuple[np.ndarray, int]]] = [{} for _ in pairs]
    for actuator in range(len(model.actuator_trntype)):
        _refuse_hidden_states(model, actuator)
        kind = _TRANSMISSION(model.actuator_trntype[actuator])
        for edge_or_nodes, exerted, node in _places(model, graph, actuator):
            at = edge_or_nodes if isinstance(edge_or_nodes, int) else _pair_between(pairs, edge_or_nodes)
            if at == len(pairs):
                assert not isinstance(edge_or_nodes, int)
                pairs.append(
                    EdgePair(named(model, _OBJECT.mjOBJ_ACTUATOR, actuator), _plain(kind.name), *edge_or_nodes)
                )
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
    # MuJoCo before 3.11 has one control per actuator, and before 3.5 no delays.
    controls, history = getattr(model, "actuator_ctrlnum", None), getattr(model, "actuator_history", None)
    rk4 = model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4)
    if controls is not None and controls[actuator] != 1:
        raise UnsupportedSceneError(f"{label} has {controls[actuator]} controls; a slot of an edge takes one.")
    if history is not None and history[actuator, 0] > 0 and (history[actuator, 1] or rk4):
        what = "with RK4" if rk4 else "of controls that are interpolated"
        other = "another integrator" if rk4 else 'interp="zoh"'
        raise UnsupportedSceneError(f"{label} has a delay {what}, which depends on the absolute time. Use {other}.")


def _places(model: mujoco.MjModel, graph: Topology, actuator: int) -> Iterator[tuple[_Place, np.ndarray, int]]:
    """Yield joints or node pairs at which an actuator acts, its gear there and the gear's node; none if it is idle."""
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
            if kind == _TRANSMISSION.mjTRN_SLIDERCRANK:
                for joint in moved_joints(graph, [(reference, node)]):
                    yield joint, gear, -1
            elif node != reference:
                yield (min(node, reference), max(node, reference)), _wrench(model, graph, other, gear), reference
        case _TRANSMISSION.mjTRN_BODY:
            if not nodes[target]:
                raise UnsupportedSceneError(
                    f"{label} acts on the contacts of a body fixed to the world, so on any body that touches it, which"
                    " no edge can represent. Let it act on a moving body."
                )
            yield (0, int(nodes[target])), gear, -1
        case _:
            raise UnsupportedSceneError(
                f"{label} acts through a {_plain(kind.name)}, which no edge can represent. Remove it."
            )


def _tendon_places(model: mujoco.MjModel, graph: Topology, tendon: int) -> Iterator[tuple[_Place, float]]:
    """Yield the joints that a tendon moves, with their coefficients in a fixed tendon, with 1 in a spatial one."""
    first, coefficients = int(model.tendon_adr[tendon]), dict[_Place, float]()
    for wrap in range(first, first + int(model.tendon_num[tendon])):
        if model.wrap_type[wrap] == int(_WRAP.mjWRAP_JOINT):
            at = int(model.wrap_objid[wrap])
            coefficients[at] = coefficients.get(at, 0.0) + float(model.wrap_prm[wrap])
    yield from (
        coefficients.items()
        if coefficients
        else ((at, 1.0) for at in moved_joints(graph, tendon_ends(model, graph, tendon)))
    )


def _pair_between(pairs: list[EdgePair], nodes: tuple[int, int]) -> int:
    """Return the index of the first pair between two nodes, ``len(pairs)`` without."""
    return next((at for at, pair in enumerate(pairs) if {pair.first, pair.second} == set(nodes)), len(pairs))


def _wrench(model: mujoco.MjModel, graph: Topology, site: int, gear: np.ndarray) -> np.ndarray:
    """Convert a gear from a site's frame to force and torque ``[6]`` about the origin and in the frame of its node."""
    _, point, orientation = site_in_node(model, graph, site)
    force, torque = np.empty(3), np.empty(3)
    mujoco.mju_rotVecQuat(force, gear[:3], orientation)
    mujoco.mju_rotVecQuat(torque, gear[3:], orientation)
    return np.concatenate((force, torque + np.cross(point, force)))


def _constraints(model: mujoco.MjModel, graph: Topology) -> Iterator[tuple[int, EdgePair]]:
    """Yield id and pair of the active connect and weld constraints between two nodes."""
    for equality in active_constraints(model):
        if joins_bodies(model, equality):
            first, second = sorted(node for node, _, _ in joined_frames(model, graph, equality))
            if first != second:
                kind = _plain(_EQUALITY(model.eq_type[equality]).name)
                yield equality, EdgePair(named(model, _OBJECT.mjOBJ_EQUALITY, equality), kind, first, second)


def _plain(name: str) -> str:
    """Return the plain name of an enumeration's member, ``"tendon"`` for ``"mjTRN_TENDON"``."""
    return name.split("_", 1)[1].lower()
