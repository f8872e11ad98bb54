"""Flat observations of a task arranged as a graph, by a declared mapping."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

_ENTRY = re.compile(r"(\w+)(?:\[(\d+)(?::(\d+))?\])?")


@dataclass(frozen=True, eq=False)
class ObservationGraph:
    """Where each number of a task's flat observation and action belongs in a graph.

    (Paper, SM Figure "Arrangement as a graph of the default 25-feature observation".)

    Nodes are the bodies that observations speak of, an edge pair is a joint between a body and the one that carries it.
    Entries are named after the task's observation: ``"height"`` is all of that entry, ``"joints[0]"`` one number
    of it and ``"body_velocities[3:6]"`` several. Every number has exactly one place. Nodes, and joints, with fewer
    numbers than others get zeros in their place.

    Args:
        name: name of the task, for messages.
        observation: size of each entry of the flat observation, in its order.
        nodes: entries of every node, by the node's name.
        joints: entries of every joint, by the names of the body that carries it and of the body that it moves.
        globals_: entries of the whole graph.
        actions: indices of the actions at a joint, by the same names as in ``joints``; joints without are left out.
        identity: show networks which node is which, one-hot. Bodies that differ need it; a network that shall serve
            graphs of several sizes must do without.

    Raises:
        ValueError: if an entry is not known or is used never or twice, a joint is between nodes that are not there, a
            body is moved by two joints or by none of a tree, or an action has no place.

    Example:
        >>> ObservationGraph.swimmer(6).num_observations
        25
    """

    name: str
    observation: Mapping[str, int]
    nodes: Mapping[str, tuple[str, ...]]
    joints: Mapping[tuple[str, str], tuple[str, ...]]
    globals_: tuple[str, ...] = ()
    actions: Mapping[tuple[str, str], tuple[int, ...]] = field(default_factory=dict)
    identity: bool = False

    def __post_init__(self) -> None:
        for node in self.node_names:  # a node that is its own ancestor has no root
            seen, at = [node], self.parent[self.node_names.index(node)]
            while at >= 0 and len(seen) <= self.num_nodes:
                seen.append(self.node_names[at])
                at = self.parent[at]
            if at >= 0:
                raise ValueError(f"Joints of {self.name!r} go round in a circle at {node!r}; they must form trees.")
        used = np.bincount([*self.node_entries[self.node_entries >= 0], *self.global_entries], minlength=1)
        used = np.pad(used, (0, max(0, self.num_observations - len(used))))
        for wrong, what in ((used == 0, "has no place in"), (used > 1, "is used twice in")):
            if wrong[: self.num_observations].any():
                raise ValueError(f"{self._entry_name(int(wrong.argmax()))!r} {what} the graph of {self.name!r}.")
        acting = sorted(index for indices in self.actions.values() for index in indices)
        if acting != list(range(len(acting))):
            raise ValueError(f"Actions of {self.name!r} must be 0, 1, ... and each at one joint, got {acting}.")
        unknown = [joint for joint in self.actions if joint not in self.joints]
        if unknown:
            raise ValueError(f"Actions of {self.name!r} are at {unknown}, which are none of its joints.")

    @classmethod
    def swimmer(cls, num_links: int) -> ObservationGraph:
        """The mapping of the paper for the suite's swimmers, of any number of links.

        Nodes hold each link's velocities along its own axes, edges the joint's angle, globals where the target is.
        """
        links = ["head", *(f"segment_{link}" for link in range(num_links - 1))]
        pairs = list(zip(links[:-1], links[1:], strict=True))
        return cls(
            name=f"swimmer{num_links}",
            observation={"joints": num_links - 1, "to_target": 2, "body_velocities": 3 * num_links},
            nodes={link: (f"body_velocities[{3 * i}:{3 * i + 3}]",) for i, link in enumerate(links)},
            joints={pair: (f"joints[{i}]",) for i, pair in enumerate(pairs)},
            globals_=("to_target",),
            actions={pair: (i,) for i, pair in enumerate(pairs)},
        )

    @classmethod
    def of_task(cls, domain: str, task: str, declared: dict | None = None) -> ObservationGraph:
        """The mapping of a task of the DeepMind Control Suite.

        Args:
            domain: of the suite.
            task: of the domain.
            declared: the mapping, as :meth:`description` has it; default: the one that is built in.

        Raises:
            ValueError: if none is declared or built in.
        """
        if declared is not None:
            return cls.from_description(declared)
        links = task.removeprefix("swimmer")
        if domain != "swimmer" or not links.isdigit():
            raise ValueError(f"Only swimmers have a mapping built in; declare an ObservationGraph for {domain} {task}.")
        return cls.swimmer(int(links))

    @property
    def node_names(self) -> tuple[str, ...]:
        """Names of the ``N`` nodes."""
        return tuple(self.nodes)

    @property
    def num_nodes(self) -> int:
        """Number of nodes ``N``."""
        return len(self.nodes)

    @property
    def num_edges(self) -> int:
        """Number of directed edges ``E``, two for each joint."""
        return 2 * len(self.joints)

    @property
    def num_actions(self) -> int:
        """Number of actions ``A``."""
        return sum(map(len, self.actions.values()))

    @cached_property
    def num_observations(self) -> int:
        """Length ``O`` of the flat observation."""
        return sum(self.observation.values())

    @cached_property
    def parent(self) -> np.ndarray:
        """``[N]`` node that carries each node, -1 where none does."""
        parent = np.full(self.num_nodes, -1)
        for before, after in self.joints:
            for node in (before, after):
                if node not in self.nodes:
                    raise ValueError(f"Joint {(before, after)} of {self.name!r}: there is no node {node!r}.")
            moved = self.node_names.index(after)
            if parent[moved] >= 0:
                raise ValueError(f"{after!r} of {self.name!r} is moved by two joints; list their entries under one.")
            parent[moved] = self.node_names.index(before)
        return parent

    @cached_property
    def moved(self) -> np.ndarray:
        """``[J]`` node that each joint moves."""
        return np.array([self.node_names.index(after) for _, after in self.joints], dtype=np.int64)

    @property
    def edge_index(self) -> np.ndarray:
        """``[2, E]`` senders above receivers; every joint's edge from the carrying body first, then back."""
        pairs = np.stack((self.parent[self.moved], self.moved))
        return np.stack((pairs, pairs[::-1]), axis=-1).reshape(2, -1)

    @cached_property
    def node_entries(self) -> np.ndarray:
        """``[N, F_n + F_j]`` index in the observation of a node's features, then of its joint's; -1 where none is."""
        own = [self._find(entries) for entries in self.nodes.values()]
        joints: list[list[int]] = [[] for _ in own]
        for node, entries in zip(self.moved, self.joints.values(), strict=True):
            joints[node] = self._find(entries)
        return np.concatenate((_table(own), _table(joints)), axis=1)

    @cached_property
    def num_node_features(self) -> int:
        """Features of a node ``F_n``, without its joint's."""
        return max((len(self._find(entries)) for entries in self.nodes.values()), default=0)

    @cached_property
    def num_joint_features(self) -> int:
        """Features of a joint ``F_j``."""
        return self.node_entries.shape[1] - self.num_node_features

    @cached_property
    def global_entries(self) -> np.ndarray:
        """``[F_g]`` index in the observation of the global features."""
        return np.array(self._find(self.globals_), dtype=np.int64)

    @cached_property
    def node_actions(self) -> np.ndarray:
        """``[N, C]`` index of the actions at the joint that moves each node; -1 where none is."""
        acting: list[list[int]] = [[] for _ in self.nodes]
        for node, joint in zip(self.moved, self.joints, strict=True):
            acting[node] = list(self.actions.get(joint, ()))
        return _table(acting)

    @cached_property
    def observation_at(self) -> np.ndarray:
        """``[O]`` where each number of the observation stands in flattened ``node_entries``, globals behind them."""
        return _listed_at(np.concatenate((self.node_entries.ravel(), self.global_entries)))

    @cached_property
    def action_at(self) -> np.ndarray:
        """``[A]`` where each action stands in flattened ``node_actions``."""
        return _listed_at(self.node_actions.ravel())

    def _find(self, entries: tuple[str, ...]) -> list[int]:
        starts = dict(zip(self.observation, np.cumsum([0, *self.observation.values()]).tolist(), strict=False))
        found = []
        for entry in entries:
            match = _ENTRY.fullmatch(entry)
            size = self.observation.get(match[1]) if match else None
            if match is None or size is None:
                raise ValueError(
                    f"{entry!r} of {self.name!r} is not known; use {list(self.observation)}, as 'name', 'name[0]'"
                    " or 'name[0:3]'."
                )
            first = int(match[2] or 0)
            last = size if match[2] is None else int(match[3] or first + 1)
            if not first < last <= size:
                raise ValueError(f"{entry!r} of {self.name!r} is out of range: {match[1]!r} has {size} numbers.")
            found += range(starts[match[1]] + first, starts[match[1]] + last)
        return found

    def _entry_name(self, index: int) -> str:
        for name, size in self.observation.items():
            if index < size:
                return f"{name}[{index}]"
            index -= size
        raise IndexError(index)

    def description(self) -> dict:
        """Plain values from which :meth:`from_description` makes the graph again."""
        return {
            "name": self.name,
            "observation": dict(self.observation),
            "nodes": {name: list(entries) for name, entries in self.nodes.items()},
            "joints": [[*joint, list(entries)] for joint, entries in self.joints.items()],
            "globals": list(self.globals_),
            "actions": [[*joint, list(indices)] for joint, indices in self.actions.items()],
            "identity": self.identity,
        }

    @classmethod
    def from_description(cls, description: dict) -> ObservationGraph:
        """The graph that :meth:`description` described; its ``globals``, ``actions`` and ``identity`` may be left out.

        Raises:
            ValueError: if something is missing, unknown or declared twice, or the graph is none.
        """
        needed, optional = ["name", "observation", "nodes", "joints"], ["globals", "actions", "identity"]
        for wrong, what in (
            ([key for key in needed if key not in description], "lacks"),
            ([key for key in description if key not in needed + optional], "has unknown"),
        ):
            if wrong:
                raise ValueError(f"The mapping {what} {wrong}; it needs {needed} and may have {optional}.")
        return cls(
            name=description["name"],
            observation=description["observation"],
            nodes={name: tuple(entries) for name, entries in description["nodes"].items()},
            joints=_by_joint(description["joints"], "joints"),
            globals_=tuple(description.get("globals", ())),
            actions=_by_joint(description.get("actions", ()), "actions"),
            identity=description.get("identity", False),
        )

    def __str__(self) -> str:
        """Readable summary: what is where."""
        lines = [
            f"Observation graph {self.name}: {self.num_observations} observations, {self.num_actions} actions,"
            f" {self.num_nodes} nodes, {len(self.joints)} joints"
        ]
        lines += [f"  node {name}: {', '.join(entries) or '-'}" for name, entries in self.nodes.items()]
        for joint, entries in self.joints.items():
            acting = ", ".join(map(str, self.actions.get(joint, ()))) or "-"
            lines.append(f"  joint {joint[0]} - {joint[1]}: {', '.join(entries) or '-'}; actions {acting}")
        return "\n".join([*lines, f"  globals: {', '.join(self.globals_) or '-'}"])


def _by_joint(rows: Sequence[Sequence], what: str) -> dict[tuple[str, str], tuple]:
    """What is declared of each joint, in rows of the bodies that carry and are moved and a list."""
    found: dict[tuple[str, str], tuple] = {}
    for row in rows:
        if len(row) != 3 or isinstance(row[2], str):
            raise ValueError(f"Each of {what!r} must be [carrying body, moved body, [...]], got {row!r}.")
        if (row[0], row[1]) in found:
            raise ValueError(f"{what!r} name {[row[0], row[1]]} twice; list all of it under one.")
        found[row[0], row[1]] = tuple(row[2])
    return found


def _listed_at(entries: np.ndarray) -> np.ndarray:
    """Where 0, 1, ... stand among entries, of which those that are -1 are none."""
    (there,) = np.nonzero(entries >= 0)
    return there[np.argsort(entries[there])]


def _table(rows: list[list[int]]) -> np.ndarray:
    """Rows of unlike length side by side, -1 where one is shorter."""
    width = max(map(len, rows), default=0)
    return np.array([[*row, *[-1] * (width - len(row))] for row in rows], dtype=np.int64).reshape(len(rows), width)
