"""Text that a scene prints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from torchrl_gn.scenes.actuator_kinds import switched_off
from torchrl_gn.scenes.constraints import active_constraints
from torchrl_gn.scenes.contact_pairs import possible_contacts
from torchrl_gn.scenes.couplings import coupled_joints, couplings
from torchrl_gn.scenes.force_elements import joint_groups, known_slots, limited_joints
from torchrl_gn.scenes.tendons import acting_tendons, tendon_joints
from torchrl_gn.scenes.topology import named
from torchrl_gn.scenes.world_contacts import MOST_POINTS

if TYPE_CHECKING:
    from torchrl_gn.scenes.scene import Scene

_MANY_CONTACTS = 500  # pairs of geoms, for which finding contact pairs takes about a second


def scene_text(scene: Scene) -> str:
    """Return the text of ``print(scene)``."""
    rotations = "no axis" if scene.yaw_frame is None else "".join("xyz"[axis] for axis in scene.yaw_frame.axes)
    rotations += " but for contacts with the world" * (scene.yaw_frame is not None and not scene.yaw_frame.exact)
    step, physics_step = 1e3 * scene.timestep, 1e3 * scene.model.opt.timestep
    counts = ((scene.num_nodes, "node"), (scene.num_edges, "edge"), (scene.num_actions, "action"))
    lines = [
        f"Scene {scene.name}: " + ", ".join(f"{count} {what}{'s' * (count != 1)}" for count, what in counts),
        f"  control step {step:g} ms = {scene.substeps} x {physics_step:g} ms",
        *([f"  after a reset, {scene.settle_steps} physics steps without control"] * bool(scene.settle_steps)),
        f"  translation-invariant along {_axes(scene.translation_invariant, 'no axis')},"
        f" rotation-invariant about {rotations}",
    ]
    mass = dict(zip(scene.static.node_names, scene.static.nodes.T, strict=True))["mass"]
    rows = [("node", "parent", "mass [kg]", "movable position", "movable rotation", "welded bodies")]
    for node, name in enumerate(scene.node_names):
        parent = scene.node_names[scene.parent[node]] if node else "-"
        welded = [body for body, attachment in scene.attachments.items() if attachment.node == node]
        free = (_axes(scene.movable[node, :3]), _axes(scene.movable[node, 3:6]))
        rows.append((name, parent, f"{mass[node]:.4g}", *free, ", ".join(welded) or "-"))
    lines += _table(rows)
    rows = [("joint", "type", "between", "limits", "action", "bounds")]
    limited = limited_joints(scene.model)
    for index, (pair, slots) in enumerate(zip(scene.pairs, scene.edge_action[::2].tolist(), strict=True)):
        limits = "-"
        if index < len(limited) and limited[index]:
            low, high = scene.model.jnt_range[index]
            limits = f"[{low:.4g}, {high:.4g}]"
        actions = [action for action in slots if action >= 0]
        motors = ", ".join(f"{action}: {scene.actuator_names[action]}" for action in actions)
        each = [f"[{scene.action_low[a]:.4g}, {scene.action_high[a]:.4g}]" for a in actions]
        bounds = f"{each[0]} each" if len(each) > 1 and len(set(each)) == 1 else ", ".join(each)
        between = f"{scene.node_names[pair.first]} - {scene.node_names[pair.second]}"
        rows.append((pair.name, pair.kind, between, limits, motors or "-", bounds or "-"))
    return "\n".join([*lines, *_table(rows), *_notes(scene), *_contacts(scene)])


def _notes(scene: Scene) -> list[str]:
    """List properties that the table of edges does not show."""
    model, kind = scene.model, mujoco.mjtObj
    idle = [name for action, name in enumerate(scene.actuator_names) if action not in scene.edge_action]
    tendons = [(each, named(model, kind.mjOBJ_TENDON, each)) for each in range(model.ntendon)]
    pulling, unknown = acting_tendons(scene)
    equalities = [named(model, kind.mjOBJ_EQUALITY, one) for one in active_constraints(model)]
    supported = [(named(model, kind.mjOBJ_EQUALITY, each.equality), each) for each in couplings(scene)[0]]
    known = {pair.name for pair in scene.pairs if pair.element == "constraint"} | {name for name, _ in supported}
    coupled = [f"{name} ({_joint_names(scene, coupled_joints(scene, each))})" for name, each in supported]
    mocap = [
        named(model, kind.mjOBJ_BODY, body)
        for body in np.flatnonzero(model.body_mocapid >= 0).tolist()
        if body not in scene.mocaps.body
    ]
    hidden = [scene.joint_names[joint] for joint in joint_groups(model, scene.body)[1]]
    forces = np.setdiff1d(scene.edge_action[scene.edge_action >= 0], scene.edge_action[::2][known_slots(scene)])
    notes = {
        "no bounds": scene.unbounded,
        "actuators that move nothing": idle,
        "actuators that are switched off": [scene.actuator_names[each] for each in np.flatnonzero(switched_off(model))],
        "actuators with activations": [scene.actuator_names[each] for each in np.unique(scene.activations.actuator)],
        "activations without a law, which are learned": [
            scene.actuator_names[each] for each in np.unique(scene.activations.actuator[~scene.activations.known])
        ],
        "delayed actuators, with their delays": [
            f"{scene.actuator_names[each]} ({1e3 * scene.delays.lag[each] * model.opt.timestep:g} ms)"
            for each in np.flatnonzero(scene.delays.lag)
        ],
        "joints without features, as their bodies do not show them": hidden,
        "joints whose angles are state": [scene.joint_names[each] for each in scene.unwrapped.joint],
        "actuators without features of their forces": [scene.actuator_names[action] for action in forces],
        "tendons that pull at joints": [
            f"{name} ({_joint_names(scene, tendon_joints(scene, each))})" for each, name in tendons if each in pulling
        ],
        "tendons without features of their own": [name for each, name in tendons if each in unknown],
        "joints coupled by constraints": coupled,
        "constraints without features": [name for name in equalities if name not in known],
        "mocap bodies, fixed at the pose of the model": mocap,
        "poses of mocap bodies, actions": scene.mocaps.names,
    }
    return [f"  {what}: {', '.join(names)}" for what, names in notes.items() if names]


def _joint_names(scene: Scene, joints: Sequence[int]) -> str:
    return ", ".join(scene.joint_names[joint] for joint in joints)


def _contacts(scene: Scene) -> list[str]:
    """List contacts, for printing; pairs of a large scene only if already found, as finding them takes seconds."""
    lines, surfaces = _world(scene), {_geom(scene, surface.geom) for surface in scene.world_contacts.surfaces}
    if "contact_pairs" not in vars(scene) and (count := len(possible_contacts(scene))) > _MANY_CONTACTS:
        return [*lines, f"  {count:,} pairs of geoms may collide; scene.contact_pairs finds which nodes can touch"]
    pairs, names = scene.contact_pairs, scene.node_names
    if len(pairs.nodes):
        more = f", and {pairs.left_out} less frequent pairs that are left out" * (pairs.left_out > 0)
        lines.append(f"  can touch: {', '.join(f'{names[a]} - {names[b]}' for a, b in pairs.nodes)}{more}")
    ignored = [name for name in pairs.ignored if name not in surfaces | {*scene.world_contacts.ignored}]
    return [*lines, *([f"  no contact features of {', '.join(ignored)}"] * bool(ignored))]


def _world(scene: Scene) -> list[str]:
    """List contacts with the world, for printing."""
    contacts = scene.world_contacts
    at = ", ".join(f"{_geom(scene, surface.geom)} ({surface.kind})" for surface in contacts.surfaces)
    notes = {
        f"touch {at}": [scene.node_names[node] for node in np.unique(contacts.node)],
        f"more than {MOST_POINTS} contact points, of which some are shown": contacts.reduced,
        "hulls of fewer faces than MuJoCo's": [_geom(scene, each.geom) for each in contacts.surfaces if each.reduced],
        "surfaces without features": contacts.ignored,
    }
    return [f"  {what}: {', '.join(names)}" for what, names in notes.items() if len(names)]


def _geom(scene: Scene, geom: int) -> str:
    return named(scene.model, mujoco.mjtObj.mjOBJ_GEOM, geom)


def _axes(flags: np.ndarray, none: str = "-") -> str:
    return "".join(axis for axis, flag in zip("xyz", flags, strict=True) if flag) or none


def _table(rows: list[tuple[str, ...]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  " + "  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
