"""State channels of actuators and joints, which follow a body's own channels."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from torchrl_gn.scenes.topology import EdgePair


@dataclass(frozen=True, eq=False)
class NodeChannels:
    """Numbers that the state holds in channels after the body's own, each at one node (base class)."""

    node: np.ndarray  # [K] node that holds each number
    slot: np.ndarray  # [K] index of each among its node's numbers of this kind

    @property
    def size(self) -> int:
        """Largest count of numbers at one node."""
        return int(self.slot.max(initial=-1)) + 1

    def mask(self, nodes: int, which: np.ndarray | None = None) -> np.ndarray:
        """Return the mask ``[nodes, size]``, bool, of all numbers, or of those that ``which`` ``[K]`` selects."""
        mask = np.zeros((nodes, self.size), dtype=bool)
        mask[self.node, self.slot] = True if which is None else which
        return mask

    def places(self, nodes: int) -> np.ndarray:
        """Return the index ``[nodes, size]`` of the number in each channel; ``K`` in channels without one."""
        places = np.full((nodes, self.size), len(self.node))
        places[self.node, self.slot] = np.arange(len(self.node))
        return places

    def at_nodes(self, numbers: np.ndarray, nodes: int) -> np.ndarray:
        """Scatter numbers ``[*B, K]`` to channels ``[*B, nodes, size]`` of their nodes, 0 elsewhere."""
        channels = np.zeros((*numbers.shape[:-1], nodes, self.size))
        channels[..., self.node, self.slot] = numbers
        return channels


def numbered(nodes: Iterable[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes ``[K]``, and the index ``[K]`` of each entry among those of its node."""
    nodes = list(nodes)
    slots = [nodes[:index].count(each) for index, each in enumerate(nodes)]
    return np.array(nodes, dtype=np.int64), np.array(slots, dtype=np.int64)


def moved_nodes(actuators: Iterable[int], pairs: Sequence[EdgePair], action: np.ndarray) -> Iterable[int]:
    """Yield the first node that each actuator moves; 1 if it moves none.

    ``action`` ``[P, C]`` holds the actuators at the edge ``pairs``.
    """
    for actuator in actuators:
        acting = np.flatnonzero((action == actuator).any(1))
        pair = pairs[acting[0]] if len(acting) else None
        yield 1 if pair is None else pair.second or pair.first
