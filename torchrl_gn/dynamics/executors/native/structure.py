"""The structure of a step, its layers and tapes, as one int64 array in the format of structure.h."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.dynamics.executors.native.expressions import OPERATIONS
from torchrl_gn.dynamics.executors.native.state_maths import StateMaths
from torchrl_gn.dynamics.executors.native.tape import Tape
from torchrl_gn.networks.layers import Gather, LayerList
from torchrl_gn.networks.linear import ACTIVATIONS
from torchrl_gn.networks.packed_layers import PANEL

MAGIC, FORMAT = 0x676E5F73746570, 3  # as in structure.h
_HEADER = 8
_GROUPS, _PHASES = 6, 2


def structure(layers: LayerList, special: StateMaths, general: StateMaths | None) -> Tensor:
    """Write a network and the state maths as words ``[W]`` int64.

    Args:
        layers: the network.
        special: state maths of the scene's usual states.
        general: state maths of all other states; None if it is not known.
    """
    words = _Words(_HEADER)
    network = words.network(layers)
    maths = [-1 if each is None else words.maths(each, layers) for each in (special, general)]
    header = [MAGIC, FORMAT, words.count, len(OPERATIONS), network, *maths, 0]
    whole = np.concatenate([np.array(header, dtype=np.int64), *words.parts])
    seal(whole)
    return torch.from_numpy(whole)


def seal(words: np.ndarray) -> None:
    """Write the checksum of a structure's words, by which the operators detect a changed word."""
    words[_HEADER - 1] = 0
    factors = 2 * np.arange(len(words), dtype=np.uint64) + np.uint64(1)
    words[_HEADER - 1] = (words.view(np.uint64) * factors).sum().view(np.int64)


class _Words:
    """Words after a header of ``count`` words; methods append words and return their place."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.parts: list[np.ndarray] = []

    def add(self, numbers: Iterable[int] | np.ndarray) -> int:
        part = np.asarray(numbers if isinstance(numbers, np.ndarray) else list(numbers), dtype=np.int64).ravel()
        self.parts.append(part)
        self.count += len(part)
        return self.count - len(part)

    def doubles(self, numbers: np.ndarray) -> int:
        return self.add(np.ascontiguousarray(numbers, dtype=np.float64).view(np.int64))

    def network(self, layers: LayerList) -> int:
        buffers, total = [], 0
        for items, width in (layers.nodes, layers.edges, *((each.count, len(each.weight)) for each in layers.layers)):
            buffers.append((items, width, total))
            total += -(-items * width // 16) * 16
        gathers, direct, unread = _backward_order(layers, [items for items, _, _ in buffers])
        rows, stored, deepest = [], 0, 0
        places = dict.fromkeys(("weights", "paired", "plain", "tables", "sample_tables"), 0)
        for index, layer in enumerate(layers.layers):
            out, depth = layer.weight.shape
            column, lists = 0, []
            for part in gathers[index]:
                fields = []
                for gather, flags in part:
                    width = buffers[gather.source][1]
                    offsets, items = self.add(gather.offsets.numpy()), self.add(gather.items.numpy())
                    fields += [gather.source, width, column, *map(int, flags), offsets, items]
                    column += width
                lists += [self.add(fields), len(part)]
            activation = 0 if layer.activation is None else 1 + list(ACTIVATIONS).index(layer.activation)
            sampled = layer.table is not None and layer.table.ndim == 3
            shared = layer.table is not None and not sampled
            forward, backward = _padded(out) * depth, _padded(depth) * out
            paired = _padded(out) * (-(-depth // 2)), _padded(depth) * (-(-out // 2))
            rows += [layer.count, out, depth, activation, stored, shared, sampled, direct[index], *lists]
            rows += [places["weights"], places["weights"] + forward, places["paired"], places["paired"] + paired[0]]
            rows += [places["sample_tables" if sampled else "tables"], places["plain"]]
            places["weights"] += forward + backward
            places["paired"] += sum(paired)
            places["plain"] += out * depth
            places["sample_tables"] += sampled * layer.count * _padded(out)
            places["tables"] += shared * layer.count * _padded(out)
            stored += layer.count * out * (activation > 0)
            deepest = max(deepest, _padded(out), _padded(depth))
        lists = [len(buffers), self.add(np.array(buffers)), len(layers.layers), self.add(rows), len(unread)]
        return self.add([*lists, self.add(unread), total, stored, deepest, *places.values()])

    def maths(self, maths: StateMaths, layers: LayerList) -> int:
        last = layers.layers[-1]
        sizes = [
            maths.is_constant.size,
            maths.is_constant.shape[1],
            len(maths.varying),
            maths.result_size,
            len(maths.results),
            not maths.change,
        ]
        sizes += [maths.actions, maths.numbers, last.count * len(last.weight)]
        sizes += [layers.nodes[0] * layers.nodes[1], layers.edges[0] * layers.edges[1]]
        sizes += [layers.nodes[1], layers.edges[1], len(last.weight)]
        lists = [self.add(maths.varying), self.add(maths.constant), self.doubles(maths.values), self.add(maths.results)]
        return self.add([*sizes, *lists, *self.tape(maths.forward), *self.tape(maths.adjoint)])

    def tape(self, tape: Tape) -> list[int]:
        instructions = self.add(np.ascontiguousarray(tape.instructions).view(np.int64))
        inputs = [self.add(each) for each in tape.inputs]
        outputs = [self.add(each) for each in tape.outputs]
        inputs += [-1] * (_GROUPS - len(inputs))
        return [instructions, self.doubles(tape.constants), *tape.phases, tape.registers, *inputs, *outputs]


_Flagged = tuple[Gather, tuple[bool, bool, bool, bool]]  # in_order, clears, writes, is_alone


def _backward_order(
    layers: LayerList, items: Sequence[int]
) -> tuple[list[tuple[list[_Flagged], list[_Flagged]]], list[bool], list[int]]:
    """Return every layer's flagged inputs and added gathers, whether it is direct, and buffers without gradient.

    The first gather that reaches a buffer in the backward pass initialises the buffer's gradient: it overwrites the
    gradient if it reads each item once, and otherwise clears it first. See structure.h for the flags.
    """
    reached, flags, direct = [False] * len(items), {}, [False] * len(layers.layers)
    reached[-1] = True
    for index, layer in reversed(list(enumerate(layers.layers))):
        gathers = [*layer.inputs, *layer.added]
        for place, gather in enumerate(gathers):
            is_alone = sum(each.source == gather.source for each in gathers) == 1
            in_order = _in_order(gather)
            first, reached[gather.source] = not reached[gather.source], True
            order = np.sort(gather.items.numpy())
            once = first and is_alone and np.array_equal(order, np.arange(items[gather.source]))
            flags[index, place] = in_order, first and not once, once, is_alone
            direct[index] |= once and in_order and len(gathers) == len(layer.inputs) == 1
    marked_layers = []
    for index, layer in enumerate(layers.layers):
        marked = [(each, flags[index, place]) for place, each in enumerate((*layer.inputs, *layer.added))]
        marked_layers.append((marked[: len(layer.inputs)], marked[len(layer.inputs) :]))
    return marked_layers, direct, [index for index, each in enumerate(reached) if not each]


def _in_order(gather: Gather) -> bool:
    """Return True if row i is the one item ``items[0] + i``."""
    offsets, items = gather.offsets.numpy(), gather.items.numpy()
    count = len(offsets) - 1
    if not np.array_equal(offsets, np.arange(count + 1)):
        return False
    return count == 0 or np.array_equal(items, items[0] + np.arange(count))


def _padded(size: int) -> int:
    return -(-size // PANEL) * PANEL
