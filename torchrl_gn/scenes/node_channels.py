"""Where body states hold numbers that bodies do not show: of actuators, and of joints."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from torchrl_gn.scenes.topology import EdgePair


@dataclass(frozen=True, eq=False)
class NodeChannels:
    """Numbers that body states hold behind those of the body, each at one node (base class)."""

    node: np.ndarray  # [K] node that holds each
    slot: np.ndarray  # [K] which of the node's numbers of this kind it is

    @property
    def size(self) -> int:
        """Most numbers that one node holds."""
        return int(self.slot.max(initial=-1)) + 1

    def mask(self, nodes: int, which: np.ndarray | None = None) -> np.ndarray:
        """``[nodes, size]`` bool, where the numbers are, or those ``which`` ``[K]`` says."""
        found = np.zeros((nodes, self.size), dtype=bool)
        found[self.node, self.slot] = True if which is None else which
        return found

    def places(self, nodes: int) -> np.ndarray:
        """``[nodes, size]`` which of the ``K`` numbers is where; ``K`` where none is."""
        found = np.full((nodes, self.size), len(self.node))
        found[self.node, self.slot] = np.arange(len(self.node))
        return found

    def at_nodes(self, numbers: np.ndarray, nodes: int) -> np.ndarray:
        """Numbers ``[*B, K]`` as channels ``[*B, nodes, size]`` of their nodes, 0 elsewhere."""
        found = np.zeros((*numbers.shape[:-1], nodes, self.size))
        found[..., self.node, self.slot] = numbers
        return found


def numbered(nodes: Iterable[int]) -> tuple[np.ndarray, np.ndarray]:
    """Nodes ``[K]``, and which of its node's numbers each is ``[K]``."""
    nodes = list(nodes)
    slots = [nodes[:index].count(each) for index, each in enumerate(nodes)]
    return np.array(nodes, dtype=np.int64), np.array(slots, dtype=np.int64)


def moved_nodes(actuators: Iterable[int], pairs: Sequence[EdgePair], action: np.ndarray) -> Iterable[int]:
    """The first node that each of some actuators moves, which act at edge ``pairs`` in the slots ``action``."""
    for actuator in actuators:
        acting = np.flatnonzero((action == actuator).any(1))
        pair = pairs[acting[0]] if len(acting) else None
        yield 1 if pair is None else pair.second or pair.first
