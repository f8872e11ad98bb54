"""Scenes: physical systems as graphs, bodies as nodes, joints as pairs of directed edges."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from functools import cached_property

import mujoco
import numpy as np

from torchrl_gn.maths.state_layout import StateLayout, body_layout
from torchrl_gn.scenes.activations import Activations
from torchrl_gn.scenes.contact_pairs import ContactPairs, find_contact_pairs
from torchrl_gn.scenes.contact_points import ContactPoints
from torchrl_gn.scenes.delays import Delays
from torchrl_gn.scenes.fingerprint import physics
from torchrl_gn.scenes.mocap import NEAR_TURN, NO_MOCAP_ACTIONS, MocapActions
from torchrl_gn.scenes.scene_text import scene_text
from torchrl_gn.scenes.topology import EdgePair, JointAnchors
from torchrl_gn.scenes.unwrapped_angles import UnwrappedAngles
from torchrl_gn.scenes.world_contacts import WorldContacts, find_world_contacts
from torchrl_gn.scenes.yaw_frame import YawFrame


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

    A node is a group of bodies welded together; its state is the state of the root body's frame. Node 0 is the world.
    Every joint gives two directed edges, parent to child, then child to parent; more pairs follow for actuators and
    equality constraints between other nodes.
    """

    name: str
    model: mujoco.MjModel  # its only sensors are the nodes' frame sensors; warm starts are off
    node_names: tuple[str, ...]  # "world" first
    joint_names: tuple[str, ...]  # [J] in the order of the edges
    actuator_names: tuple[str, ...]  # in the order of mjData.ctrl
    body: np.ndarray  # [N] MuJoCo id of each node's root body
    parent: np.ndarray  # [N] parent node; the world's is -1
    pairs: tuple[EdgePair, ...]  # [E / 2] pair i has edges 2 i and 2 i + 1; joints come first
    senders: np.ndarray  # [E]
    receivers: np.ndarray  # [E]
    edge_action: np.ndarray  # [E, C] actions at each edge, padded with -1; C is the most at an edge (or 1)
    static: StaticGraph
    # [N, 12 + K] bool mask of movable components: position 3, rotation 3, linear velocity 3, angular velocity 3, in the
    # world frame; then activations, past controls, unwrapped angles
    movable: np.ndarray
    translation_invariant: np.ndarray  # [3] bool, world axes along which the dynamics do not depend on position
    yaw_frame: YawFrame | None  # None if the dynamics depend on the yaw
    joint_anchors: JointAnchors
    contact_points: ContactPoints | None
    activations: Activations  # activations of actuators, with their state channels
    delays: Delays  # delays of actuators, with the state channels of past controls
    unwrapped: UnwrappedAngles  # angles of joints that may make whole turns, with their state channels
    mocaps: MocapActions  # mocap poses that are actions, after the actuators' controls
    action_low: np.ndarray  # [A] -inf where unbounded
    action_high: np.ndarray  # [A]
    substeps: int  # physics steps in one control step
    attachments: dict[str, Attachment] = field(default_factory=dict)  # named bodies that are not the root of a node
    settle_steps: int = 0  # physics steps without control after a reset
    wide_starts: float = 0.5  # for MJCF models: share of start poses anywhere within the joint limits
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
        return len(self.action_names)

    @cached_property
    def without_mocap_actions(self) -> Scene:
        """The scene with the actuators' actions alone; its mocap bodies keep the model's poses."""
        count = len(self.actuator_names)
        low, high = self.action_low[:count], self.action_high[:count]
        return replace(self, mocaps=NO_MOCAP_ACTIONS, action_low=low, action_high=high)

    @property
    def action_names(self) -> tuple[str, ...]:
        """``[A]`` names of actuators, then of components of the mocap poses that are actions."""
        return self.actuator_names + self.mocaps.names

    @property
    def rest_action(self) -> np.ndarray:
        """``[A]`` zero controls and the model's mocap poses."""
        return np.concatenate((np.zeros(len(self.actuator_names)), self.mocaps.rest))

    @property
    def random_action_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds ``[A]`` of random actions; mocap quaternions stay near the model's."""
        low, high, rest_action = self.action_low.copy(), self.action_high.copy(), self.rest_action
        mocap_index = np.arange(self.num_actions) - len(self.actuator_names)
        turns = (mocap_index >= 0) & (mocap_index % 7 > 2)
        low[turns], high[turns] = rest_action[turns] - NEAR_TURN, rest_action[turns] + NEAR_TURN
        return low, high

    @property
    def mocap_poses(self) -> np.ndarray:
        """Bounds of mocap actions, then poses of all mocap bodies, flat; empty if no pose is an action."""
        if not len(self.mocaps):
            return np.empty(0)
        at = self.model.body_mocapid >= 0
        poses = self.model.body_pos[at].ravel(), self.model.body_quat[at].ravel()
        return np.concatenate((self.mocaps.low, self.mocaps.high, *poses))

    @property
    def timestep(self) -> float:
        """Control time step, seconds."""
        return self.substeps * self.model.opt.timestep

    @cached_property
    def physics_size(self) -> int:
        """Length ``S`` of the full MuJoCo state (``mjSTATE_FULLPHYSICS``)."""
        return mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS)

    @cached_property
    def contact_pairs(self) -> ContactPairs:
        """Pairs of nodes that can touch; the first access takes up to seconds."""
        return find_contact_pairs(self)

    @cached_property
    def world_contacts(self) -> WorldContacts:
        """Points of bodies that can touch the world, and the surfaces that they can touch."""
        return find_world_contacts(self)

    @cached_property
    def layout(self) -> StateLayout:
        """Layout of a node's state: 13 channels of the body, then ``K`` channels of actuators and joints."""
        return body_layout(self.activations.size, self.delays.size, self.unwrapped.size)

    @property
    def state_size(self) -> int:
        """Size ``C`` of a node's state: position 3, quaternion 4, velocities 6, ``K`` more."""
        return self.layout.size

    def states(self, sensors: np.ndarray, physics: np.ndarray) -> np.ndarray:
        """Return states ``[*B, N, C]`` from ``mjData.sensordata`` ``[*B, S]`` and physics ``[*B, S']`` at that time."""
        bodies = sensors.reshape(*sensors.shape[:-1], self.num_nodes, 13)
        parts = [bodies]
        if self.model.na:
            first = 1 + self.model.nq + self.model.nv
            act = physics[..., first : first + self.model.na]
            parts.append(self.activations.at_nodes(act, self.num_nodes))
        if self.delays.size:
            past = self.delays.read(self.model, self.substeps, physics)
            parts.append(self.delays.at_nodes(past, self.num_nodes))
        if self.unwrapped.size:
            angles = physics[..., 1 + self.model.jnt_qposadr[self.unwrapped.joint]]
            parts.append(self.unwrapped.at_nodes(angles, self.num_nodes))
        return np.concatenate(parts, axis=-1) if parts[1:] else bodies

    @property
    def reference_state(self) -> np.ndarray:
        """``[N, C]`` states of the model's reference pose, at rest."""
        data = mujoco.MjData(self.model)
        for stage in ("kinematics", "comPos", "comVel", "sensorPos", "sensorVel"):
            getattr(mujoco, f"mj_{stage}")(self.model, data)
        return self.states(data.sensordata, self.rest_physics).copy()

    @property
    def rest_physics(self) -> np.ndarray:
        """``[S]`` physics of the model's reference pose, at rest, at time 0."""
        state = np.empty(self.physics_size)
        mujoco.mj_getState(self.model, mujoco.MjData(self.model), state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        return state

    @property
    def predicted(self) -> np.ndarray:
        """``[N]`` bool, nodes with a movable component."""
        return np.any(self.movable, axis=1)

    @property
    def unbounded(self) -> tuple[str, ...]:
        """Names of actions without bounds."""
        bounded = np.isfinite(self.action_low) & np.isfinite(self.action_high)
        return tuple(name for name, known in zip(self.action_names, bounded, strict=True) if not known)

    def description(self) -> dict:
        """Return JSON-able values that rebuild the scene.

        Raises:
            SceneError: if the scene was made from an ``MjSpec``, whose XML rounds numbers.
        """
        if not self.origin:
            raise SceneError(
                f"Scene {self.name!r} was made from an MjSpec, which has no exact description;"
                " load the model from an MJCF file."
            )
        options = {"name": self.name, "timestep": self.timestep, "settle_steps": self.settle_steps}
        return {**options, **self.origin, "fingerprint": self.fingerprint()}

    def fingerprint(self) -> str:
        """Return a hash of names, control step, bounds and MuJoCo's physical quantities to six digits."""
        return hashlib.sha256("\n".join(physics(self)).encode()).hexdigest()[:16]

    def __str__(self) -> str:
        return scene_text(self)
