"""Where body states hold numbers of actuators."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from torchrl_gn.scenes.topology import EdgePair


@dataclass(frozen=True, eq=False)
class ActuatorChannels:
    """Numbers of actuators that body states hold, each at one node (base class)."""

    actuator: np.ndarray  # [K] actuator of each
    node: np.ndarray  # [K] node that holds it: the first one that the actuator moves
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

    def at_nodes(self, numbers: np.ndarray, nodes: int) -> np.ndarray:
        """Numbers ``[*B, K]`` as channels ``[*B, nodes, size]`` of their nodes, 0 elsewhere."""
        found = np.zeros((*numbers.shape[:-1], nodes, self.size))
        found[..., self.node, self.slot] = numbers
        return found


def holding_nodes(
    actuators: Iterable[int], pairs: Sequence[EdgePair], action: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and slots ``[K]`` for numbers of ``actuators`` that act at edge ``pairs`` in the slots ``action``."""
    nodes = []
    for actuator in actuators:
        acting = np.flatnonzero((action == actuator).any(1))
        pair = pairs[acting[0]] if len(acting) else None
        nodes.append(1 if pair is None else pair.second or pair.first)
    slots = [nodes[:index].count(each) for index, each in enumerate(nodes)]
    return np.array(nodes, dtype=np.int64), np.array(slots, dtype=np.int64)
