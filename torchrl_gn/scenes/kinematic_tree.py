"""Kinematic trees: graphs of robots that joint encoders observe, without a model of their bodies."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial

import numpy as np
import torch

from torchrl_gn.maths.state_layout import StateLayout, joint_layout
from torchrl_gn.scenes.physical_parameters import PhysicalParameters
from torchrl_gn.scenes.scene import StaticGraph
from torchrl_gn.scenes.topology import JointAnchors

_MOST_JOINTS, _MOST_COMMANDS = 1_000, 100_000
_BOUNDS = (("action_low", -np.inf), ("action_high", np.inf))


@dataclass(frozen=True, eq=False)
class KinematicTree:
    """Kinematic tree of a robot known by its joint encoders (paper, SM "Real JACO").

    Node 0 is the base, the others are the joints' bodies; node states follow :func:`~torchrl_gn.maths.joint_layout`.
    The tree replaces a :class:`~torchrl_gn.scenes.Scene` in forward models, losses and errors.

    Raises:
        ValueError: if there is no joint, or an argument does not fit.
    """

    name: str
    joint_names: tuple[str, ...]  # names of the J joints, from the base outwards
    timestep: float  # control step, seconds
    commands: tuple[tuple[int, ...], ...]  # indices of the commands at each joint; empty without a motor
    extras: tuple[str, ...] = ()  # names of further channels, each one number per joint
    action_low: np.ndarray = field(default_factory=lambda: np.empty(0))  # [A]; default: unbounded
    action_high: np.ndarray = field(default_factory=lambda: np.empty(0))
    joint_parents: tuple[int, ...] = ()  # parent of each joint, -1 for the base; default: the joint before it
    history: int = 0  # past steps whose commands follow the present ones, for each joint and in the action

    yaw_frame = None
    contact_points = None
    world_contacts = None
    contact_pairs = None

    def __post_init__(self) -> None:
        settle = partial(object.__setattr__, self)
        # JSON takes no NumPy numbers.
        settle("timestep", float(self.timestep))
        settle("commands", tuple(tuple(map(int, indices)) for indices in self.commands))
        settle("joint_parents", tuple(map(int, self.joint_parents)) or tuple(range(-1, self.num_joints - 1)))
        if not self.joint_names or len(self.commands) != len(self.joint_names):
            raise ValueError(
                f"Robot {self.name!r} needs at least one joint, and commands for each; got"
                f" {len(self.joint_names)} joints and commands for {len(self.commands)}."
            )
        if self.num_joints > _MOST_JOINTS:
            raise ValueError(f"Robot {self.name!r} has {self.num_joints} joints; {_MOST_JOINTS} at most.")
        if any(not 0 <= index < _MOST_COMMANDS for indices in self.commands for index in indices):
            raise ValueError(
                f"commands={self.commands} of {self.name!r} must be indices from 0, below {_MOST_COMMANDS}."
            )
        if not 0 < self.timestep < np.inf:
            raise ValueError(f"timestep={self.timestep} of {self.name!r} must be positive.")
        if len(self.joint_parents) != self.num_joints or any(
            not -1 <= before < joint for joint, before in enumerate(self.joint_parents)
        ):
            raise ValueError(
                f"joint_parents={self.joint_parents} of {self.name!r} must be an earlier joint, or -1, for each joint."
            )
        if self.history < 0 or any(
            len(commands) % (self.history + 1) for commands in (*self.commands, range(self.num_actions))
        ):
            raise ValueError(
                f"commands={self.commands} of {self.name!r} must be as many for each of {self.history} past steps"
                " as for the present step."
            )
        for which, infinite in _BOUNDS:
            count = len(getattr(self, which))
            if count not in (0, self.num_actions):
                raise ValueError(
                    f"{which} of {self.name!r} must be [{self.num_actions}], one a command, got [{count}]."
                )
            if count == 0:
                settle(which, np.full(self.num_actions, infinite))

    @property
    def num_joints(self) -> int:
        return len(self.joint_names)

    @property
    def num_nodes(self) -> int:
        return self.num_joints + 1

    @property
    def num_edges(self) -> int:
        return 2 * self.num_joints

    @property
    def num_actions(self) -> int:
        return 1 + max((index for indices in self.commands for index in indices), default=-1)

    @property
    def rest_action(self) -> np.ndarray:
        """``[A]`` commands of 0."""
        return np.zeros(self.num_actions)

    @property
    def random_action_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds ``[A]`` of random commands."""
        return self.action_low, self.action_high

    @property
    def unbounded(self) -> tuple[str, ...]:
        """Names of commands without bounds."""
        bounded = np.isfinite(self.action_low) & np.isfinite(self.action_high)
        return tuple(f"command {index}" for index in np.flatnonzero(~bounded))

    @property
    def present(self) -> KinematicTree:
        """The robot with the commands of the present step alone."""
        steps = self.history + 1
        commands = tuple(joint_commands[: len(joint_commands) // steps] for joint_commands in self.commands)
        low, high = (bound[: self.num_actions // steps] for bound in (self.action_low, self.action_high))
        return replace(self, commands=commands, action_low=low, action_high=high, history=0)

    @cached_property
    def layout(self) -> StateLayout:
        """Components of a node's state."""
        return joint_layout(self.extras)

    @property
    def state_size(self) -> int:
        """Size of a node's state: cosine, sine, velocity, extras."""
        return self.layout.size

    @property
    def node_names(self) -> tuple[str, ...]:
        return ("base", *self.joint_names)

    @property
    def parent(self) -> np.ndarray:
        """``[N]`` parent node of each node; the base's is -1."""
        return np.array([-1, *(before + 1 for before in self.joint_parents)])

    @property
    def senders(self) -> np.ndarray:
        """``[E]`` sending node of each edge."""
        return np.stack((self.parent[1:], np.arange(self.num_joints) + 1), 1).reshape(-1)

    @property
    def receivers(self) -> np.ndarray:
        """``[E]`` receiving node of each edge."""
        return np.stack((np.arange(self.num_joints) + 1, self.parent[1:]), 1).reshape(-1)

    @property
    def edge_action(self) -> np.ndarray:
        """``[E, C]`` commands at each edge's joint, padded with -1; ``C`` is the most at a joint (or 1)."""
        most = max(1, *map(len, self.commands))
        padded = [[*indices, *[-1] * (most - len(indices))] for indices in self.commands]
        return np.repeat(np.array(padded, dtype=np.int64), 2, axis=0)

    @property
    def movable(self) -> np.ndarray:
        """``[N, 2 + extras]`` bool mask of movable components: all but the base's."""
        return np.repeat(np.arange(self.num_nodes)[:, None] > 0, 2 + len(self.extras), axis=1)

    @property
    def predicted(self) -> np.ndarray:
        return np.any(self.movable, axis=1)

    @property
    def translation_invariant(self) -> np.ndarray:
        """``[3]`` bool: no axis, as there are no positions."""
        return np.zeros(3, dtype=bool)

    @property
    def joint_anchors(self) -> JointAnchors:
        """No joint anchors, as there are no positions."""
        nodes, offset = np.arange(self.num_nodes), np.zeros((self.num_nodes, 3))
        return JointAnchors(nodes, offset, offset, np.zeros((self.num_nodes, self.num_nodes)), nodes)

    @property
    def static(self) -> StaticGraph:
        """Static graph: one-hot node and joint, and direction of edges."""
        direction = np.tile([1.0, -1.0], self.num_joints)[:, None]
        edges = np.concatenate((direction, np.repeat(np.eye(self.num_joints), 2, axis=0)), 1)
        names = tuple(f"is_{name}" for name in self.node_names)
        return StaticGraph(np.eye(self.num_nodes), edges, np.zeros(0), names, ("direction", *names[1:]), ())

    def values(self) -> PhysicalParameters:
        """Return the physical parameters: static features, and neutral values for the spatial parameters of bodies."""
        n, e, static = self.num_nodes, self.num_edges, self.static
        arrays = (static.nodes, static.edges, static.globals_, np.zeros((e, 3)), np.array([1.0, 0, 0, 0]), np.zeros(3))
        arrays += (np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 0, 3)), np.zeros((n, 0)))
        arrays += (np.zeros((n, 7)), np.zeros((e, 8)), np.zeros((e, 0, 9)))
        arrays += (np.zeros((1, 16)), np.zeros((1, 1, 2)), np.zeros((1, 22)))
        return PhysicalParameters(*(torch.as_tensor(array, dtype=torch.float64, device="cpu") for array in arrays))

    def description(self) -> dict:
        """Return JSON-able values from which :func:`~torchrl_gn.scenes.scene_from_description` rebuilds the tree."""
        tree = {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(self).items()}
        tree["commands"] = [list(indices) for indices in self.commands]
        for which, _ in _BOUNDS:  # JSON has no infinity
            tree[which] = [None if np.isinf(value) else float(value) for value in tree[which]]
        return {"kinematic_tree": tree, "fingerprint": self.fingerprint()}

    @classmethod
    def from_description(cls, description: dict) -> KinematicTree:
        """Rebuild a tree from its :meth:`description`."""
        tree = dict(description["kinematic_tree"])
        for which, infinite in _BOUNDS:
            tree[which] = np.array([infinite if value is None else value for value in tree[which]], dtype=np.float64)
        for which in ("joint_names", "extras"):
            tree[which] = tuple(tree[which])
        return cls(**tree)

    def fingerprint(self) -> str:
        """Return a hash of all arguments."""
        text = (self.name, *self.joint_names, f"{self.timestep:.6g}", str(self.commands), str(self.joint_parents))
        bounds = (f"{value:.6g}" for value in (*self.action_low, *self.action_high))
        past = (f"history {self.history}",) * (self.history > 0)
        return hashlib.sha256("\n".join((*text, *self.extras, *bounds, *past)).encode()).hexdigest()[:16]

    def __str__(self) -> str:
        now, step = self.present, 1e3 * self.timestep
        past = f" and those of {self.history} past steps" if self.history else ""
        lines = [f"Robot {self.name}: {self.num_joints} joints, {now.num_actions} commands{past}, step {step:g} ms"]
        for name, indices, before in zip(self.joint_names, now.commands, self.joint_parents, strict=True):
            acting = ", ".join(map(str, indices)) or "none"
            lines.append(f"  {name}, parent {self.node_names[before + 1]}: commands {acting}")
        return "\n".join(lines)


def tree_states(angle: np.ndarray, velocity: np.ndarray, extras: Sequence[np.ndarray] = ()) -> np.ndarray:
    """Return node states ``[..., J + 1, 3 + extras]``, float64, of angles [rad] and velocities [rad/s] ``[..., J]``.

    A joint's state is cosine and sine of the angle, velocity, and ``extras`` ``[..., J]`` in the tree's order; the
    base's state is 1, 0, 0, ...
    """
    bodies = np.stack((np.cos(angle), np.sin(angle), velocity, *extras), axis=-1).astype(np.float64)
    base = np.zeros((*bodies.shape[:-2], 1, bodies.shape[-1]))
    base[..., 0] = 1
    return np.concatenate((base, bodies), axis=-2)
