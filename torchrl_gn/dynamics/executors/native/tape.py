"""Scalar expressions as a tape of instructions that C++ runs on many samples at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchrl_gn.dynamics.executors.native.expressions import OPERATIONS, Expressions, Scalar, UntraceableError

CODES = {name: code for code, name in enumerate(OPERATIONS)}
"""Numbers of the operations, as ``enum Operation`` of tape.h has them."""
INSTRUCTION = np.dtype([("code", "u2"), ("out", "u2"), ("a", "u2"), ("b", "u2"), ("c", "u2"), ("_", "u2"), ("k", "u4")])
_MOST_REGISTERS = 2**16 - 1


@dataclass(frozen=True)
class Tape:
    """Instructions of consecutive phases, which share their registers.

    Inputs of group ``g`` are written to registers ``inputs[g]`` before the phase that needs them; afterwards outputs of
    a phase are read from ``outputs[phase]``.
    """

    instructions: np.ndarray  # [I] INSTRUCTION
    constants: np.ndarray  # [K] float64
    phases: tuple[int, ...]  # where each phase ends
    inputs: tuple[np.ndarray, ...]  # registers of each group of inputs, int32; -1: never read
    outputs: tuple[np.ndarray, ...]  # registers of each phase's outputs
    registers: int


def assemble(graph: Expressions, groups: Sequence[Sequence[Scalar]], phases: Sequence[Sequence[Any]]) -> Tape:
    """Tape of the outputs of every phase: only what they need, each once, in as few registers as its order allows."""
    results = [[_index(graph, each) for each in outputs] for outputs in phases]
    inputs = {each.index for group in groups for each in group}
    order, ends = _schedule(graph.nodes, results, inputs)
    order, ends, nodes = _fused(graph.nodes, order, ends, results)

    # Registers: inputs that are read keep theirs, as a group may be written between phases; others are reused after
    # their last use.
    is_read = {operand for index in order for operand in nodes[index][1]} | {i for outputs in results for i in outputs}
    last = {operand: position for position, index in enumerate(order) for operand in nodes[index][1]}
    released: dict[int, list[int]] = {}  # before an instruction: outputs that were read after the phase before it
    expiring: dict[int, list[int]] = {}  # with an instruction: its operands
    kept_until = {index: ends[phase] for phase, outputs in enumerate(results) for index in outputs}
    for index in order:
        read, until = last.get(index, -1), kept_until.get(index, -1)
        (released if until > read else expiring).setdefault(max(read, until), []).append(index)
    used = (each.index for group in groups for each in group if each.index in is_read)
    where = {index: register for register, index in enumerate(used)}
    count, free = len(where), []
    instructions: list[tuple[int, ...]] = []
    constants: dict[float, int] = {}
    for position, index in enumerate(order):
        free += [where[each] for each in released.get(position, ())]
        operation, operands, constant = nodes[index]
        a, b, c = (*[where[operand] for operand in operands], 0, 0, 0)[:3]
        free += [where[each] for each in expiring.get(position, ())]
        if not free:
            free.append(count)
            count += 1
        where[index] = free.pop()
        k = constants.setdefault(constant, len(constants))
        instructions.append((CODES[operation], where[index], a, b, c, 0, k))
    if count > _MOST_REGISTERS:
        raise UntraceableError(f"The state maths of this scene needs {count} registers.")
    return Tape(
        instructions=np.array(instructions, dtype=INSTRUCTION),
        constants=np.array(list(constants) or [0.0]),
        phases=tuple(ends),
        inputs=tuple(np.array([where.get(each.index, -1) for each in group], dtype=np.int32) for group in groups),
        outputs=tuple(np.array([where[index] for index in outputs], dtype=np.int32) for outputs in results),
        registers=max(count, 1),
    )


def _index(graph: Expressions, value: Any) -> int:
    return value.index if isinstance(value, Scalar) else graph.make("constant", (), float(value)).index


def _schedule(nodes: list, results: list[list[int]], inputs: set[int]) -> tuple[list[int], list[int]]:
    """Operations in an order that puts operands first and close, and where each phase ends."""
    order, ends, done = [], [], set(inputs)
    for outputs in results:
        for output in outputs:
            stack = [output]
            while stack:
                index = stack[-1]
                if index in done:
                    stack.pop()
                    continue
                missing = [operand for operand in nodes[index][1] if operand not in done]
                if missing:
                    stack += missing[::-1]
                else:
                    order.append(index)
                    done.add(index)
                    stack.pop()
        ends.append(len(order))
    return order, ends


def _fused(nodes: list, order: list[int], ends: list[int], results: list[list[int]]) -> tuple[list, list, list]:
    """Products that only one sum in the same phase reads, as one instruction with it."""
    uses: dict[int, int] = {}
    for index in order:
        for operand in nodes[index][1]:
            uses[operand] = uses.get(operand, 0) + 1
    for outputs in results:
        for index in outputs:
            uses[index] = uses.get(index, 0) + 2  # an output is kept
    phase_of = {}
    for phase, (start, end) in enumerate(zip([0, *ends[:-1]], ends, strict=True)):
        phase_of.update(dict.fromkeys(order[start:end], phase))
    nodes, gone = list(nodes), set()
    for index in order:
        operation, operands, _ = nodes[index]
        if operation not in ("add", "sub"):
            continue
        choices = ((1, 0), (0, 1)) if operation == "add" else ((1, 0),)
        for product, rest in choices:
            one, other = operands[product], operands[rest]
            kind, factors, constant = nodes[one]
            if uses[one] != 1 or phase_of.get(one) != phase_of[index] or kind not in ("mul", "mul_c"):
                continue
            if kind == "mul":
                nodes[index] = ("madd" if operation == "add" else "nmadd", (*factors, other), 0.0)
            else:
                nodes[index] = ("madd_c", (*factors, other), constant if operation == "add" else -constant)
            gone.add(one)
            break
    kept, new_ends = [], []
    for start, end in zip([0, *ends[:-1]], ends, strict=True):
        kept += [index for index in order[start:end] if index not in gone]
        new_ends.append(len(kept))
    return kept, new_ends, nodes
