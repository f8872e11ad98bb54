"""Scenes: physical systems as graphs, bodies as nodes, joints as pairs of directed edges."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field
from functools import cached_property

import mujoco
import numpy as np

from torchrl_gn.scenes.contact_pairs import ContactPairs, find_contact_pairs, possible_contacts
from torchrl_gn.scenes.contact_points import ContactPoints
from torchrl_gn.scenes.fingerprint import physics
from torchrl_gn.scenes.force_elements import joint_groups, known_slots, limited_joints
from torchrl_gn.scenes.topology import EdgePair, JointAnchors, named
from torchrl_gn.scenes.yaw_frame import YawFrame

_MANY_CONTACTS = 500  # pairs of geoms from which on contact pairs take about a second to find


class SceneError(ValueError):
    """A model cannot be read as a scene."""


class UnsupportedSceneError(SceneError):
    """The graph cannot represent an element of a valid MuJoCo model."""


class SceneChangedWarning(UserWarning):
    """A scene rebuilt from its description has other physics than the original."""


@dataclass(frozen=True)
class StaticGraph:
    """Static graph ``G_s`` of a scene (paper, SM "Mujoco variables"), float64."""

    nodes: np.ndarray  # [N, F_n] features in parent-relative frames
    edges: np.ndarray  # [E, F_e]
    globals_: np.ndarray  # [F_g]
    node_names: tuple[str, ...]  # names of the F_n columns, such as "mass" or "inertia[0]"
    edge_names: tuple[str, ...]
    global_names: tuple[str, ...]


@dataclass(frozen=True)
class Attachment:
    """A named body welded to a node."""

    node: int
    pos: np.ndarray  # [3] position in the node's frame, metres
    quat: np.ndarray  # [4] orientation in the node's frame, w-first


@dataclass(frozen=True, eq=False)
class Scene:
    """One physical system as a graph, read from a MuJoCo model.

    A node is a group of bodies welded together, its state the frame of the group's root body. Node 0 is the world.
    Every joint gives two directed edges, parent to child, then child to parent; more pairs follow for actuators and
    equality constraints between other nodes.
    """

    name: str
    model: mujoco.MjModel  # its last sensors are the frame sensors of the nodes; warm starts are off
    node_names: tuple[str, ...]  # "world" first
    joint_names: tuple[str, ...]  # [J] in the order of the edges
    actuator_names: tuple[str, ...]  # in the order of mjData.ctrl
    body: np.ndarray  # [N] MuJoCo id of each node's root body
    parent: np.ndarray  # [N] parent node; the world's is -1
    pairs: tuple[EdgePair, ...]  # [E / 2] of edges 2 i and 2 i + 1; the joints' come first
    senders: np.ndarray  # [E]
    receivers: np.ndarray  # [E]
    edge_action: np.ndarray  # [E, C] actions at each edge, -1 where fewer than C, the most (or 1)
    static: StaticGraph
    movable: np.ndarray  # [N, 12] bool: position 3, rotation 3, linear velocity 3, angular velocity 3; world frame
    translation_invariant: np.ndarray  # [3] bool, world axes along which the dynamics do not depend on position
    yaw_frame: YawFrame | None  # if the dynamics do not depend on the yaw
    joint_anchors: JointAnchors
    contact_points: ContactPoints | None
    action_low: np.ndarray  # [A] -inf where unbounded
    action_high: np.ndarray  # [A]
    substeps: int  # physics steps in one control step
    attachments: dict[str, Attachment] = field(default_factory=dict)  # named bodies that are not the root of a node
    settle_steps: int = 0  # physics steps without control after a reset
    wide_starts: float = 0.5  # share of the start poses of a model from MJCF that are anywhere within the joint limits
    origin: dict = field(default_factory=dict, repr=False)  # source of the model, part of description()

    @property
    def num_nodes(self) -> int:
        """Number of nodes ``N``, world included."""
        return len(self.node_names)

    @property
    def num_edges(self) -> int:
        return len(self.senders)

    @property
    def num_actions(self) -> int:
        return len(self.actuator_names)

    @property
    def timestep(self) -> float:
        """Control time step, seconds."""
        return self.substeps * self.model.opt.timestep

    def require_timestep(self, timestep: float, what: str) -> None:
        """Raise ValueError if ``what`` learned with another control time step, in seconds."""
        if not math.isclose(timestep, self.timestep, rel_tol=1e-6):
            raise ValueError(
                f"{what} learned with control steps of {1e3 * timestep:g} ms, scene {self.name!r} has"
                f" {1e3 * self.timestep:g} ms: load it with timestep={timestep:g}."
            )

    @cached_property
    def physics_size(self) -> int:
        """Length ``S`` of the full MuJoCo state (``mjSTATE_FULLPHYSICS``)."""
        return mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS)

    @cached_property
    def contact_pairs(self) -> ContactPairs:
        """Nodes that can meet; the first call takes up to seconds."""
        return find_contact_pairs(self)

    @property
    def state_size(self) -> int:
        return 13  # position 3, quaternion 4, linear velocity 3, angular velocity 3

    @property
    def sensor_slice(self) -> slice:
        """Slice of ``mjData.sensordata`` that, reshaped to ``[..., N, 13]``, holds the state."""
        return slice(self.model.nsensordata - 13 * self.num_nodes, self.model.nsensordata)

    @property
    def predicted(self) -> np.ndarray:
        """``[N]`` bool, nodes with a movable component."""
        return np.any(self.movable, axis=1)

    @property
    def unbounded(self) -> tuple[str, ...]:
        """Names of actuators whose actions have no bounds."""
        bounded = np.isfinite(self.action_low) & np.isfinite(self.action_high)
        return tuple(name for name, known in zip(self.actuator_names, bounded, strict=True) if not known)

    def description(self) -> dict:
        """JSON-able values that rebuild the scene; SceneError if it is of an ``MjSpec``, whose XML rounds numbers."""
        if not self.origin:
            raise SceneError(
                f"Scene {self.name!r} was made from an MjSpec, which has no exact description;"
                " load the model from an MJCF file."
            )
        own = {"name": self.name, "timestep": self.timestep, "settle_steps": self.settle_steps}
        return {**own, **self.origin, "fingerprint": self.fingerprint()}

    def fingerprint(self) -> str:
        """Hash of names, control step, bounds and MuJoCo's physical quantities to six digits."""
        return hashlib.sha256("\n".join(physics(self)).encode()).hexdigest()[:16]

    def __str__(self) -> str:
        rotations = "no axis" if self.yaw_frame is None else "xyz"[self.yaw_frame.axis]
        rotations += " but for contacts with the world" * (self.yaw_frame is not None and not self.yaw_frame.exact)
        step, physics_step = 1e3 * self.timestep, 1e3 * self.model.opt.timestep
        counts = ((self.num_nodes, "node"), (self.num_edges, "edge"), (self.num_actions, "action"))
        lines = [
            f"Scene {self.name}: " + ", ".join(f"{count} {what}{'s' * (count != 1)}" for count, what in counts),
            f"  control step {step:g} ms = {self.substeps} x {physics_step:g} ms",
            *([f"  after a reset, {self.settle_steps} physics steps without control"] * bool(self.settle_steps)),
            f"  translation-invariant along {_axes(self.translation_invariant, 'no axis')},"
            f" rotation-invariant about {rotations}",
        ]
        mass = dict(zip(self.static.node_names, self.static.nodes.T, strict=True))["mass"]
        rows = [("node", "parent", "mass [kg]", "movable position", "movable rotation", "welded bodies")]
        for node, name in enumerate(self.node_names):
            parent = self.node_names[self.parent[node]] if node else "-"
            welded = [body for body, attachment in self.attachments.items() if attachment.node == node]
            free = (_axes(self.movable[node, :3]), _axes(self.movable[node, 3:6]))
            rows.append((name, parent, f"{mass[node]:.4g}", *free, ", ".join(welded) or "-"))
        lines += _table(rows)
        rows = [("joint", "type", "between", "limits", "action", "bounds")]
        limited = limited_joints(self.model)
        for index, (pair, slots) in enumerate(zip(self.pairs, self.edge_action[::2].tolist(), strict=True)):
            limits = "-"
            if index < len(limited) and limited[index]:
                low, high = self.model.jnt_range[index]
                limits = f"[{low:.4g}, {high:.4g}]"
            actions = [action for action in slots if action >= 0]
            motors = ", ".join(f"{action}: {self.actuator_names[action]}" for action in actions)
            bounds = ", ".join(f"[{self.action_low[a]:.4g}, {self.action_high[a]:.4g}]" for a in actions)
            between = f"{self.node_names[pair.first]} - {self.node_names[pair.second]}"
            rows.append((pair.name, pair.kind, between, limits, motors or "-", bounds or "-"))
        return "\n".join([*lines, *_table(rows), *self._notes(), *self._contacts()])

    def _notes(self) -> list[str]:
        """What the edges do not show."""
        model, kind = self.model, mujoco.mjtObj
        idle = [name for action, name in enumerate(self.actuator_names) if action not in self.edge_action]
        driven = model.actuator_trnid[model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON, 0]
        tendons = [named(model, kind.mjOBJ_TENDON, tendon) for tendon in range(model.ntendon) if tendon not in driven]
        shown = {pair.name for pair in self.pairs if pair.element == "constraint"}
        equalities = [named(model, kind.mjOBJ_EQUALITY, one) for one in np.flatnonzero(model.eq_active0).tolist()]
        mocap = [named(model, kind.mjOBJ_BODY, body) for body in np.flatnonzero(model.body_mocapid >= 0).tolist()]
        hidden = [self.joint_names[joint] for joint in joint_groups(model, self.body)[1]]
        forces = np.setdiff1d(self.edge_action[self.edge_action >= 0], self.edge_action[::2][known_slots(self)])
        notes = {
            "no bounds": self.unbounded,
            "actuators that move nothing": idle,
            "joints without features, as their bodies do not show them": hidden,
            "actuators without features of their forces": [self.actuator_names[action] for action in forces],
            "passive tendons, without edges": tendons,
            "constraints without edges": [name for name in equalities if name not in shown],
            "mocap bodies, fixed at the pose of the model": mocap,
        }
        return [f"  {what}: {', '.join(names)}" for what, names in notes.items() if names]

    def _contacts(self) -> list[str]:
        """What can meet, for printing; of a large scene pairs only if they are known: finding them takes seconds."""
        points = self.contact_points
        touching = [] if points is None else [self.node_names[node] for node in np.unique(points.node)]
        lines = [f"  touch the plane: {', '.join(touching)}"] * bool(touching)
        if "contact_pairs" not in vars(self) and (count := len(possible_contacts(self))) > _MANY_CONTACTS:
            return [*lines, f"  {count:,} pairs of geoms may collide; scene.contact_pairs finds which nodes can meet"]
        pairs, names = self.contact_pairs, self.node_names
        if len(pairs.nodes):
            more = f", and {pairs.left_out} less frequent pairs that are left out" * (pairs.left_out > 0)
            lines.append(f"  can meet: {', '.join(f'{names[a]} - {names[b]}' for a, b in pairs.nodes)}{more}")
        if pairs.ignored:
            lines.append(f"  no contact features of {', '.join(pairs.ignored)}")
        return lines


def _axes(flags: np.ndarray, none: str = "-") -> str:
    return "".join(axis for axis, flag in zip("xyz", flags, strict=True) if flag) or none


def _table(rows: list[tuple[str, ...]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  " + "  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
