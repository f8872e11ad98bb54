"""State maths as CUDA source: one thread computes one sample, in float64."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass

import numpy as np

from torchrl_gn.dynamics.executors.cuda.nvrtc import THREADS
from torchrl_gn.dynamics.executors.native.expressions import OPERATIONS
from torchrl_gn.dynamics.executors.native.state_maths import StateMaths
from torchrl_gn.dynamics.executors.native.tape import CODES, Tape

_PART = 4000  # most instructions of a kernel

_NAMES = {code: name for name, code in CODES.items()}
_EXPRESSIONS = {
    "constant": "{k}",
    "add_c": "{a} + {k}",
    "sub_c": "{k} - {a}",
    "mul_c": "{a} * {k}",
    "div_c": "{k} / {a}",
    "sqrt": "sqrt({a})",
    "sin": "sin({a})",
    "cos": "cos({a})",
    "abs": "fabs({a})",
    "max_c": "larger({a}, {k})",
    "min_c": "smaller({a}, {k})",
    "less_c": "{a} < {k} ? 1.0 : 0.0",
    "greater_c": "{a} > {k} ? 1.0 : 0.0",
    "equal_c": "{a} == {k} ? 1.0 : 0.0",
    "floor": "floor({a})",
    "look_up": "look_up(table_{table}, {a})",
    "add": "{a} + {b}",
    "sub": "{a} - {b}",
    "mul": "{a} * {b}",
    "div": "{a} / {b}",
    "atan2": "atan2({a}, {b})",
    "max": "larger({a}, {b})",
    "min": "smaller({a}, {b})",
    "less": "{a} < {b} ? 1.0 : 0.0",
    "madd_c": "{a} * {k} + {b}",
    "where": "{a} != 0.0 ? {b} : {c}",
    "madd": "{a} * {b} + {c}",
    "nmadd": "{c} - {a} * {b}",
}


@dataclass(frozen=True)
class KernelTypes:
    """C++ types of numbers in memory: ``float``, ``double`` or ``bfloat16``."""

    state: str
    action: str
    network: str


@dataclass(frozen=True)
class Layout:
    """Array sizes of a sample; the network's arrays are ``[items, samples, width]``."""

    state: int  # numbers of a state, N * C
    result: int  # numbers of a result
    actions: int
    node_inputs: int  # inputs of all nodes, N * F_n
    node_width: int  # F_n
    edge_width: int  # F_e
    output_width: int  # F_out


def kernel_sources(name: str, maths: StateMaths, layout: Layout, types: KernelTypes) -> tuple[list[str], int]:
    """Return CUDA sources of one of :data:`KERNELS`, to be run in order, and the number of scratch registers.

    ``inputs`` computes network inputs from state and action, ``result`` the next state (or change) from the network's
    output. ``inputs_adjoint`` and ``result_adjoint`` backpropagate through them. All sources define a kernel ``name``
    with the arguments n, stride of the numbers, ``scratch`` ``[registers, n]`` (values for later sources), and the
    tensors of the kernel.
    """
    tape = maths.separate(name)
    parts = _statements(tape, _loads(maths, layout), _outputs(name, maths, layout))
    parts[-1] += _zeros(name, maths, layout)
    parameters = ", ".join(
        f"{'' if kind.startswith('out ') else 'const '}{kind.removeprefix('out ')}* __restrict__ {argument}"
        for argument, kind in (("scratch", "out double"), *_ARGUMENTS[name])
    )
    kinds = "\n".join(f"typedef {kind} {letter};" for letter, kind in zip("SAW", astuple(types), strict=True))
    head = f'extern "C" __global__ void __launch_bounds__({THREADS}) {name}'
    sources, tables = [], _tables(tape)
    for lines in parts:
        body = "\n  ".join(lines)
        sources.append(
            f"{_PRELUDE}\n{kinds}\n{tables}\n{head}(long long n, long long stride, {parameters}) {{\n"
            f"  const long long s = blockIdx.x * {THREADS}ll + threadIdx.x;\n  if (s >= n) return;\n  {body}\n}}\n"
        )
    return sources, tape.registers if len(sources) > 1 else 0


KERNELS = ("inputs", "result", "inputs_adjoint", "result_adjoint")
# Types: S of the state, A of the action, W of the network. "out": the kernel writes this array.
_ARGUMENTS: dict[str, tuple[tuple[str, str], ...]] = {
    "inputs": (
        ("state", "S"),
        ("action", "A"),
        ("numbers", "double"),
        ("nodes", "out W"),
        ("edges", "out W"),
    ),
    "result": (("state", "S"), ("action", "A"), ("numbers", "double"), ("output", "W"), ("result", "out S")),
    "inputs_adjoint": (
        ("state", "S"),
        ("action", "A"),
        ("numbers", "double"),
        ("grad_nodes", "W"),
        ("grad_edges", "W"),
        ("grad_state", "out S"),
        ("grad_action", "out A"),
    ),
    "result_adjoint": (
        ("state", "S"),
        ("action", "A"),
        ("numbers", "double"),
        ("output", "W"),
        ("grad_result", "S"),
        ("grad_output", "out W"),
        ("grad_state", "out S"),
        ("grad_action", "out A"),
    ),
}


def _loads(maths: StateMaths, at: Layout) -> Callable[[int, int], str]:
    """Return a function from a group of inputs and an index to the C++ expression of this input."""

    def load(group: int, index: int) -> str:
        if group == 0:
            return f"state[s * {at.state} + {maths.varying[index]}]"
        if group == 1:
            return f"action[s * {at.actions} + {index}]"
        if group == 2:
            return _of_items("output", index, at.output_width)
        if group == 3:
            return f"numbers[s * stride + {index}]"
        if group == 4:
            return f"grad_result[s * {at.result} + {maths.results[index]}]"
        if index < at.node_inputs:
            return _of_items("grad_nodes", index, at.node_width)
        return _of_items("grad_edges", index - at.node_inputs, at.edge_width)

    return lambda group, index: f"(double){load(group, index)}"


def _outputs(name: str, maths: StateMaths, at: Layout) -> Callable[[int], tuple[str, str]]:
    """Return a function from the index of an output to its place and type."""
    outputs = len(maths._groups[2])

    def gradient(index: int) -> tuple[str, str]:
        if index < len(maths.varying):
            return f"grad_state[s * {at.state} + {maths.varying[index]}]", "S"
        return f"grad_action[s * {at.actions} + {index - len(maths.varying)}]", "A"

    def place(index: int) -> tuple[str, str]:
        if name == "inputs":
            if index < at.node_inputs:
                return _of_items("nodes", index, at.node_width), "W"
            return _of_items("edges", index - at.node_inputs, at.edge_width), "W"
        if name == "result":
            return f"result[s * {at.result} + {maths.results[index]}]", "S"
        if name == "inputs_adjoint":
            return gradient(index)
        return (_of_items("grad_output", index, at.output_width), "W") if index < outputs else gradient(index - outputs)

    return place


def _of_items(array: str, index: int, width: int) -> str:
    item, column = divmod(index, width)
    return f"{array}[({item} * n + s) * {width} + {column}]"


def _statements(
    tape: Tape, load: Callable[[int, int], str], place: Callable[[int], tuple[str, str]]
) -> list[list[str]]:
    """Return the statements of a tape, in parts.

    Inputs are loaded before their first use and outputs stored after their last write, so that few values live. Code is
    split because compile time grows faster than its length; a part stores the values that later parts read.
    """
    inputs = {
        int(register): f"r{register} = {load(group, index)};"
        for group, each in enumerate(tape.inputs)
        for index, register in enumerate(each)
        if register >= 0
    }
    instructions = [
        (
            int(each["out"]),
            _NAMES[int(each["code"])],
            [int(each[name]) for name in "abc"],
            float(tape.constants[each["k"]]),
            int(each["k"]),
        )
        for each in tape.instructions
    ]
    instructions = [(out, code, operands[: OPERATIONS[code]], *k) for out, code, operands, *k in instructions]
    last = {out: position for position, (out, *_) in enumerate(instructions)}
    stores: dict[int, list[str]] = {}
    for index, register in enumerate(tape.outputs[0]):
        where, kind = place(index)
        stores.setdefault(int(register), []).append(f"{where} = ({kind})r{register};")
    parts = [range(at, min(at + _PART, len(instructions))) for at in range(0, max(len(instructions), 1), _PART)]
    read_later: set[int] = set()  # registers that later parts read before they write them
    leaves: list[set[int]] = []
    for part in reversed(parts):
        leaves.append(read_later & {instructions[position][0] for position in part})
        for position in reversed(part):
            out, _, operands, *_ = instructions[position]
            read_later.discard(out)
            read_later |= {each for each in operands if each not in inputs}
    leaves.reverse()

    statements = []
    for part, left in zip(parts, leaves, strict=True):
        lines, known = [], set()
        if part.start == 0:
            for register in stores.keys() - last.keys():
                lines += [inputs[register], *stores[register]]
                known.add(register)
        for position in part:
            out, code, operands, k, table = instructions[position]
            for register in operands:
                if register not in known:
                    lines.append(inputs.get(register, f"r{register} = scratch[{register} * n + s];"))
            known |= {out, *operands}
            names = dict(zip("abc", (f"r{register}" for register in operands), strict=False))
            lines.append(f"r{out} = {_EXPRESSIONS[code].format(k=_number(k), table=table, **names)};")
            if last[out] == position:
                lines += stores.get(out, [])
        lines += [f"scratch[{register} * n + s] = r{register};" for register in sorted(left)]
        declared = f"double {', '.join(f'r{each}' for each in sorted(known))};" if known else ""
        statements.append([declared, *lines])
    return statements


def _tables(tape: Tape) -> str:
    """Return the definitions of a tape's look-up tables, named by their places among its constants."""
    definitions = []
    for start in np.unique(tape.instructions["k"][tape.instructions["code"] == CODES["look_up"]]).tolist():
        numbers = tape.constants[start : start + 1 + int(tape.constants[start])]
        definitions.append(
            f"__device__ const double table_{start}[] = {{{', '.join(map(_number, numbers.tolist()))}}};\n"
        )
    return "".join(definitions)


def _zeros(name: str, maths: StateMaths, at: Layout) -> list[str]:
    """Return statements that set the channels of a change that no tape computes to zero."""
    if name != "result" or not maths.change:
        return []
    return [f"result[s * {at.result} + {i}] = (S)0.0;" for i in np.setdiff1d(np.arange(at.result), maths.results)]


def _number(value: float) -> str:
    if np.isnan(value):
        return "NOT_A_NUMBER"
    if np.isinf(value):
        return "INFINITE" if value > 0 else "(-INFINITE)"
    return f"({value:.17e})"


_PRELUDE = """\
#define INFINITE __longlong_as_double(0x7ff0000000000000ll)
#define NOT_A_NUMBER __longlong_as_double(0x7ff8000000000000ll)

// NaN if either is.
__device__ __forceinline__ double larger(double a, double b) { return (a < b) | (b != b) ? b : a; }
__device__ __forceinline__ double smaller(double a, double b) { return (b < a) | (b != b) ? b : a; }
// Number x of a table, which begins with its size; the nearest one beyond its ends, the first for NaN.
__device__ __forceinline__ double look_up(const double* table, double x) {
  const double last = *table - 1.0, place = x < last ? x : last;
  return table[1 + (place > 0.0 ? (long long)place : 0)];
}

struct bfloat16 {
  unsigned short bits;
  bfloat16() = default;
  __device__ explicit bfloat16(double value) {
    const float single = (float)value;
    unsigned int all = __float_as_uint(single);
    bits = single != single ? 0x7fc0 : (all + 0x7fffu + ((all >> 16) & 1u)) >> 16;
  }
  __device__ operator double() const { return __uint_as_float((unsigned int)bits << 16); }
};
"""
