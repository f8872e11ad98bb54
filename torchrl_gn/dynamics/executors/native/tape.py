"""Scalar expressions as a tape of instructions that C++ runs on many samples at once."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchrl_gn.dynamics.executors.native.expressions import OPERATIONS, Expressions, Scalar, UntraceableError

CODES = {name: code for code, name in enumerate(OPERATIONS)}
"""Numbers of the operations, in the order of ``labels`` in tape.h."""
INSTRUCTION = np.dtype([("code", "u2"), ("out", "u2"), ("a", "u2"), ("b", "u2"), ("c", "u2"), ("_", "u2"), ("k", "u4")])
_MOST_REGISTERS = 2**16 - 1


@dataclass(frozen=True)
class Tape:
    """Instructions of consecutive phases, which share their registers.

    The caller writes the inputs of group ``g`` to registers ``inputs[g]`` before the phase that needs them, and reads
    the outputs of a phase from registers ``outputs[phase]`` after it.
    """

    instructions: np.ndarray  # [I] INSTRUCTION
    constants: np.ndarray  # [K] float64; a table is its size, then its numbers
    phases: tuple[int, ...]  # where each phase ends
    inputs: tuple[np.ndarray, ...]  # registers of each group of inputs, int32; -1: never read
    outputs: tuple[np.ndarray, ...]  # registers of each phase's outputs
    registers: int


def assemble(graph: Expressions, groups: Sequence[Sequence[Scalar]], phases: Sequence[Sequence[Any]]) -> Tape:
    """Return the tape that computes the outputs of every phase.

    It computes only the expressions that the outputs need, each once, in as few registers as its order allows.

    Raises:
        UntraceableError: if it needs too many registers.
    """
    results = [[_index(graph, each) for each in outputs] for outputs in phases]
    inputs = [each.index for group in groups for each in group]
    order, phase_ends = _schedule(graph.nodes, results, inputs)
    order, phase_ends, nodes = _fused(graph.nodes, order, phase_ends, results)
    arguments = [nodes[index][1] for index in order]

    # Inputs that are read keep their registers, as a group may be written between phases. Values are numbered: these
    # inputs, then the results of instructions; -1, the last entry, stands for no value.
    is_read = np.zeros(len(nodes), dtype=bool)
    is_read[[*itertools.chain(*arguments, *results)]] = True
    used = list(dict.fromkeys(index for index in inputs if is_read[index]))
    value_of = np.full(len(nodes), -1)
    value_of[used], value_of[order] = np.arange(len(used)), len(used) + np.arange(len(order))
    operands = np.full((3, len(order)), -1)
    for place, row in enumerate(itertools.zip_longest(*arguments, fillvalue=-1)):
        nodes_read = np.array(row, dtype=np.int64)
        operands[place] = np.where(nodes_read < 0, -1, value_of[nodes_read])
    places = _registers(operands, [value_of[outputs] for outputs in results], phase_ends, len(used))
    count = int(places.max(initial=0)) + 1
    if count > _MOST_REGISTERS:
        raise UntraceableError(f"The state maths of this scene needs {count} registers.")

    instructions = np.zeros(len(order), dtype=INSTRUCTION)
    instructions["code"] = [CODES[nodes[index][0]] for index in order]
    instructions["out"] = places[len(used) : -1]
    for name, row in zip("abc", operands, strict=True):
        instructions[name] = places[row]
    single = [nodes[index][2] for index in order if nodes[index][0] != "look_up"]
    known = {value: place for place, value in enumerate(dict.fromkeys(single or [0.0]))}
    starts = len(known) + np.cumsum([0, *(1 + len(each) for each in graph.tables)])
    instructions["k"] = [
        starts[int(constant)] if operation == "look_up" else known[constant]
        for operation, _, constant in (nodes[index] for index in order)
    ]
    tables = [number for each in graph.tables for number in (len(each), *each.tolist())]
    places = np.where(is_read, places[value_of], -1).astype(np.int32)
    return Tape(
        instructions=instructions,
        constants=np.array([*known, *tables]),
        phases=tuple(phase_ends),
        inputs=tuple(places[np.array([each.index for each in group], dtype=np.int64)] for group in groups),
        outputs=tuple(places[np.array(outputs, dtype=np.int64)] for outputs in results),
        registers=count,
    )


def _registers(operands: np.ndarray, results: list[np.ndarray], ends: list[int], inputs: int) -> np.ndarray:
    """Return registers ``[V + 1]`` for values ``[V]``: inputs keep theirs, others free theirs after the last use.

    The last entry, for no value, is register 0.
    """
    count = operands.shape[1]
    read, output_until = np.full((2, inputs + count + 1), -1)
    for row in operands:
        positions = np.full_like(read, -1)
        positions[row] = np.arange(count)  # of several positions the last one stays
        np.maximum(read, positions, out=read)
    for outputs, end in zip(results, ends, strict=True):
        output_until[outputs] = end
    # An instruction frees the operands that it is the last to read. The first instruction after a phase first frees the
    # outputs of the phase.
    until = np.maximum(read, output_until)[inputs:-1]
    order = np.argsort(2 * until + (output_until <= read)[inputs:-1], kind="stable").tolist()
    places, free, start, most = [0] * count, [], 0, inputs
    for position, released in enumerate(np.bincount(until, minlength=count)[:count].tolist()):
        if released:
            free += [places[each] for each in order[start : start + released]]
            start += released
        if not free:
            free.append(most)
            most += 1
        places[position] = free.pop()
    return np.array([*range(inputs), *places, 0], dtype=np.int64)


def _index(graph: Expressions, value: Any) -> int:
    return value.index if isinstance(value, Scalar) else graph.make("constant", (), float(value)).index


def _schedule(nodes: list, results: list[list[int]], inputs: list[int]) -> tuple[list[int], list[int]]:
    """Return operations in an order that puts operands first and close, and the end of each phase."""
    order, ends, done = [], [], bytearray(len(nodes))
    for index in inputs:
        done[index] = 1
    for outputs in results:
        stack = outputs[::-1]
        while stack:
            index = stack.pop()
            if index < 0:  # its operands are done
                order.append(~index)
                done[~index] = 1
            elif not done[index]:
                missing = [operand for operand in nodes[index][1] if not done[operand]]
                if missing:
                    stack.append(~index)
                    stack += missing[::-1]
                else:
                    order.append(index)
                    done[index] = 1
        ends.append(len(order))
    return order, ends


def _fused(nodes: list, order: list[int], ends: list[int], results: list[list[int]]) -> tuple[list, list, list]:
    """Fuse each product that only one sum reads, in the same phase, into one instruction with this sum."""
    read = [*itertools.chain.from_iterable(nodes[index][1] for index in order)]
    counts = np.bincount(np.array(read, dtype=np.int64), minlength=len(nodes))
    counts[[*itertools.chain(*results)]] += 2  # outputs are kept
    phase = np.full(len(nodes), -1)
    phase[order] = np.searchsorted(ends, np.arange(len(order)), side="right")
    uses, phase_of = counts.tolist(), phase.tolist()
    nodes, gone = list(nodes), bytearray(len(nodes))
    for index in order:
        operation, operands, _ = nodes[index]
        if operation not in ("add", "sub"):
            continue
        choices = ((1, 0), (0, 1)) if operation == "add" else ((1, 0),)
        for product, rest in choices:
            one, other = operands[product], operands[rest]
            if uses[one] != 1 or phase_of[one] != phase_of[index]:
                continue
            kind, factors, constant = nodes[one]
            if kind == "mul":
                nodes[index] = ("madd" if operation == "add" else "nmadd", (*factors, other), 0.0)
            elif kind == "mul_c":
                nodes[index] = ("madd_c", (*factors, other), constant if operation == "add" else -constant)
            else:
                continue
            gone[one] = 1
            break
    remaining, new_ends = [], []
    for start, end in zip([0, *ends[:-1]], ends, strict=True):
        remaining += [index for index in order[start:end] if not gone[index]]
        new_ends.append(len(remaining))
    return remaining, new_ends, nodes
