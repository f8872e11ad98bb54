"""Observation graphs: a declared mapping of flat task observations to a graph."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

_ENTRY = re.compile(r"(\w+)(?:\[(\d+)(?::(\d+))?\])?")


@dataclass(frozen=True, eq=False)
class ObservationGraph:
    """Mapping of each number of a task's flat observation and action to a place in a graph.

    (Paper, SM Figure "Arrangement as a graph of the default 25-feature observation".)

    Nodes are bodies, joints are pairs of edges between parent and child body. ``"height"`` names a whole entry of the
    observation, ``"joints[0]"`` one number of an entry, ``"body_velocities[3:6]"`` several. Every number has exactly
    one place; nodes and joints with fewer numbers than others are padded with zeros.

    Raises:
        ValueError: if an entry is unknown or not used exactly once, a joint names an unknown node, the joints do not
            form trees, or an action has no place.
    """

    name: str  # of the task, for messages
    observation: Mapping[str, int]  # size of each entry of the flat observation, in order
    nodes: Mapping[str, tuple[str, ...]]  # entries of every node
    joints: Mapping[tuple[str, str], tuple[str, ...]]  # entries of every joint, by its (parent, child) bodies
    globals_: tuple[str, ...] = ()  # entries of the whole graph
    actions: Mapping[tuple[str, str], tuple[int, ...]] = field(default_factory=dict)  # indices of each joint's actions
    identity: bool = False  # give networks each node's index, one-hot; not for graphs of several sizes

    def __post_init__(self) -> None:
        ancestor = np.arange(self.num_nodes)
        for _ in self.nodes:
            ancestor = np.append(self.parent, -1)[ancestor]
        for node in np.flatnonzero(ancestor >= 0):
            raise ValueError(
                f"Joints of {self.name!r} form a cycle at {self.node_names[node]!r}; they must form trees."
            )
        names = [f"{name}[{index}]" for name, size in self.observation.items() for index in range(size)]
        used = np.bincount([*self.node_entries[self.node_entries >= 0], *self.global_entries], minlength=len(names))
        for wrong, what in ((used == 0, "has no place in"), (used > 1, "is used twice in")):
            if wrong.any():
                raise ValueError(f"{names[wrong.argmax()]!r} {what} the graph of {self.name!r}.")
        acting = sorted(index for indices in self.actions.values() for index in indices)
        if acting != list(range(len(acting))):
            raise ValueError(f"Actions of {self.name!r} must be 0, 1, ... and each at one joint, got {acting}.")
        if unknown := [joint for joint in self.actions if joint not in self.joints]:
            raise ValueError(f"Actions of {self.name!r} are at {unknown}, which are none of its joints.")

    @classmethod
    def swimmer(cls, num_links: int) -> ObservationGraph:
        """Return the paper's mapping of the suite's swimmers, with any number of links."""
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
        """Return the mapping of a suite task.

        Args:
            domain: the task's domain, such as ``"swimmer"``.
            task: the task's name, such as ``"swimmer6"``.
            declared: a :meth:`description` of the mapping. Default: the built-in mapping of swimmers.

        Raises:
            ValueError: if the task has no built-in mapping, and none is declared.
        """
        if declared is not None:
            return cls.from_description(declared)
        links = task.removeprefix("swimmer")
        if domain != "swimmer" or not links.isdigit():
            raise ValueError(f"Only swimmers have a mapping built in; declare an ObservationGraph for {domain} {task}.")
        return cls.swimmer(int(links))

    @property
    def node_names(self) -> tuple[str, ...]:
        return tuple(self.nodes)

    @property
    def num_nodes(self) -> int:
        return len(self.nodes)

    @property
    def num_edges(self) -> int:
        return 2 * len(self.joints)

    @property
    def num_actions(self) -> int:
        return sum(map(len, self.actions.values()))

    @cached_property
    def num_observations(self) -> int:
        """Length ``O`` of the flat observation."""
        return sum(self.observation.values())

    @cached_property
    def parent(self) -> np.ndarray:
        """``[N]`` parent of each node, -1 for roots."""
        parent = np.full(self.num_nodes, -1)
        for before, after in self.joints:
            for node in (before, after):
                if node not in self.nodes:
                    raise ValueError(f"Joint {(before, after)} of {self.name!r}: there is no node {node!r}.")
            child = self.node_names.index(after)
            if parent[child] >= 0:
                raise ValueError(
                    f"{after!r} of {self.name!r} is the child of two joints; list their entries under one."
                )
            parent[child] = self.node_names.index(before)
        return parent

    @cached_property
    def moved(self) -> np.ndarray:
        """``[J]`` child node of each joint."""
        return np.array([self.node_names.index(after) for _, after in self.joints], dtype=np.int64)

    @property
    def edge_index(self) -> np.ndarray:
        """``[2, E]`` senders and receivers; each joint's edge from the parent, then back."""
        pairs = np.stack((self.parent[self.moved], self.moved))
        return np.stack((pairs, pairs[::-1]), axis=-1).reshape(2, -1)

    @cached_property
    def node_entries(self) -> np.ndarray:
        """``[N, F_n + F_j]`` observation index of each node's features, then of its joint's; -1 is padding."""
        node_entries = [self._find(entries) for entries in self.nodes.values()]
        joints = self._at_children([self._find(entries) for entries in self.joints.values()])
        return np.concatenate((_padded(node_entries), joints), axis=1)

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
        """``[F_g]`` observation index of the global features."""
        return np.array(self._find(self.globals_), dtype=np.int64)

    @cached_property
    def node_actions(self) -> np.ndarray:
        """``[N, C]`` actions at the joint to each node's parent; -1 is padding."""
        return self._at_children([list(self.actions.get(joint, ())) for joint in self.joints])

    def _at_children(self, rows: list[list[int]]) -> np.ndarray:
        row_of_node = dict(zip(self.moved.tolist(), rows, strict=True))
        return _padded([row_of_node.get(node, []) for node in range(self.num_nodes)])

    @cached_property
    def observation_at(self) -> np.ndarray:
        """``[O]`` position of each observation in flattened ``node_entries`` followed by ``global_entries``."""
        return _positions(np.concatenate((self.node_entries.ravel(), self.global_entries)))

    @cached_property
    def action_at(self) -> np.ndarray:
        """``[A]`` position of each action in flattened ``node_actions``."""
        return _positions(self.node_actions.ravel())

    def _find(self, entries: tuple[str, ...]) -> list[int]:
        starts = dict(zip(self.observation, np.cumsum([0, *self.observation.values()]).tolist(), strict=False))
        indices = []
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
            indices += range(starts[match[1]] + first, starts[match[1]] + last)
        return indices

    def description(self) -> dict:
        """Return JSON-able values from which :meth:`from_description` rebuilds the graph."""
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
        """Rebuild from :meth:`description`; ValueError if a key is missing or unknown, or the values make no graph."""
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
    """Return the entries of each (parent, child) from rows ``[parent, child, entries]``."""
    by_joint: dict[tuple[str, str], tuple] = {}
    for row in rows:
        if len(row) != 3 or isinstance(row[2], str):
            raise ValueError(f"Each of {what!r} must be [parent body, child body, [...]], got {row!r}.")
        if (row[0], row[1]) in by_joint:
            raise ValueError(f"{what!r} name {[row[0], row[1]]} twice; list their entries under one.")
        by_joint[row[0], row[1]] = tuple(row[2])
    return by_joint


def _positions(entries: np.ndarray) -> np.ndarray:
    """Return the positions of 0, 1, ... in ``entries``, ignoring -1."""
    (valid,) = np.nonzero(entries >= 0)
    return valid[np.argsort(entries[valid])]


def _padded(rows: list[list[int]]) -> np.ndarray:
    """Stack rows of unequal length, padded with -1."""
    width = max(map(len, rows), default=0)
    return np.array([[*row, *[-1] * (width - len(row))] for row in rows], dtype=np.int64).reshape(len(rows), width)
