"""Scalar expressions for a step's state maths, given a scene's constants.

Equal expressions are shared. Products with 0 or 1 and sums with 0 are simplified, which reduces the quaternions and
matrices of a planar scene to the cosine and sine of an angle. Gradients are by reverse-mode differentiation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

# Operations and their number of operands that are expressions; the suffix "_c" stands for a constant operand.
OPERATIONS = {
    name: arity
    for arity, names in enumerate(
        (
            "constant input",
            "add_c sub_c mul_c div_c sqrt sin cos abs max_c min_c less_c greater_c equal_c floor look_up",
            "add sub mul div atan2 max min less madd_c",
            "where madd nmadd",
        )
    )
    for name in names.split()
}
"""``sub_c`` is constant - x and ``div_c`` constant / x; ``madd`` is a * b + c, ``nmadd`` c - a * b; ``look_up`` is
entry x of the table whose number is the constant."""


class UntraceableError(RuntimeError):
    """A function uses an operation that has no scalar form here."""

    # Not a TypeError, which Python would turn into "not equal" in a comparison.


class Expressions:
    """All expressions of one trace, numbered so that operands come before their results."""

    def __init__(self) -> None:
        self.nodes: list[tuple[str, tuple[int, ...], float]] = []  # operation, operands, constant
        self._known: dict[tuple, int] = {}
        self.tables: list[np.ndarray] = []  # look-up tables of constants, each [size] float64

    def make(self, operation: str, operands: tuple[int, ...] = (), constant: float = 0.0) -> Scalar:
        key = operation, operands, constant
        count = len(self.nodes)
        index = self._known.setdefault(key, count)
        if index == count:
            self.nodes.append(key)
        return Scalar(self, index)

    def table(self, values: np.ndarray) -> int:
        """Return the number of a table of constants ``[size]``; add a new table."""
        for number, each in enumerate(self.tables):
            if np.array_equal(each, values):
                return number
        self.tables.append(np.array(values, dtype=np.float64))
        return len(self.tables) - 1

    def inputs(self, name: int, count: int) -> list[Scalar]:
        """Make the inputs of a group."""
        return [self.make("input", (), float(name * 2**32 + i)) for i in range(count)]


class Scalar:
    """One expression; arithmetic with expressions and numbers makes new expressions."""

    __slots__ = ("graph", "index")
    __hash__ = None  # pyright: ignore[reportAssignmentType]

    def __init__(self, graph: Expressions, index: int) -> None:
        self.graph, self.index = graph, index

    def _one(self, operation: str, constant: float = 0.0) -> Scalar:
        return self.graph.make(operation, (self.index,), float(constant))

    def _two(self, operation: str, other: Scalar) -> Scalar:
        a, b = self.index, other.index
        return self.graph.make(operation, (b, a) if operation in ("add", "mul") and b < a else (a, b))

    def __add__(self, other: Any) -> Any:
        if isinstance(other, Scalar):
            return self._two("add", other)
        return self if other == 0 else self._one("add_c", other)

    __radd__ = __add__

    def __mul__(self, other: Any) -> Any:
        if isinstance(other, Scalar):
            return self._two("mul", other)
        if other == 0:
            return 0.0
        if other == 1:
            return self
        operation, operands, constant = self.graph.nodes[self.index]
        if operation == "mul_c" and constant != 0:
            return Scalar(self.graph, operands[0]) * (constant * float(other))
        return self._one("mul_c", other)

    __rmul__ = __mul__

    def __neg__(self) -> Any:
        return self * -1.0

    def __sub__(self, other: Any) -> Any:
        if isinstance(other, Scalar):
            return 0.0 if other.index == self.index else self._two("sub", other)
        return self + -other

    def __rsub__(self, other: Any) -> Any:
        return -self if other == 0 else self._one("sub_c", other)

    def __truediv__(self, other: Any) -> Any:
        if isinstance(other, Scalar):
            return self._two("div", other)
        return self * (1.0 / other)

    def __rtruediv__(self, other: Any) -> Any:
        return 0.0 if other == 0 else self._one("div_c", other)

    def __lt__(self, other: Any) -> Any:
        return self._two("less", other) if isinstance(other, Scalar) else self._one("less_c", other)

    def __gt__(self, other: Any) -> Any:
        return other < self if isinstance(other, Scalar) else self._one("greater_c", other)

    def __eq__(self, other: Any) -> Any:
        if isinstance(other, Scalar):
            raise NotImplementedError("equality of two varying numbers")
        return self._one("equal_c", other)

    def __bool__(self) -> bool:
        raise NotImplementedError("a branch on a varying number")


def zero_times(x: Any) -> Any:
    """Return ``0 * x``, not simplified because it propagates NaN; 0 if ``x`` is a number."""
    return x.graph.make("mul_c", (x.index,), 0.0) if isinstance(x, Scalar) else 0.0


def divide(a: Any, b: Any) -> Any:
    """Return ``a / b``; numbers are divided as in torch, also by zero."""
    if isinstance(a, Scalar) or isinstance(b, Scalar):
        return a / b
    with np.errstate(all="ignore"):
        return float(np.float64(a) / np.float64(b))


def _function(operation: str, of_number: Callable[[float], float]) -> Callable[[Any], Any]:
    def apply(x: Any) -> Any:
        if isinstance(x, Scalar):
            return x._one(operation)
        with np.errstate(all="ignore"):
            return float(of_number(float(x)))

    return apply


sqrt, sin, cos, floor = (_function(name, getattr(np, name)) for name in ("sqrt", "sin", "cos", "floor"))
absolute = _function("abs", abs)


def where(condition: Any, a: Any, b: Any) -> Any:
    """Return ``a`` if the condition holds, else ``b``."""
    if not isinstance(condition, Scalar):
        return a if condition else b
    if a is b or (not isinstance(a, Scalar) and not isinstance(b, Scalar) and a == b):
        return a
    if isinstance(a, Scalar) and isinstance(b, Scalar) and a.index == b.index:
        return a
    graph = condition.graph
    a, b = (each if isinstance(each, Scalar) else graph.make("constant", (), float(each)) for each in (a, b))
    return graph.make("where", (condition.index, a.index, b.index))


def look_up(values: np.ndarray, index: Any) -> Any:
    """Return ``values[index]`` of constants ``[size]`` for a whole number; an index beyond the ends is clamped."""
    if isinstance(index, Scalar):
        return index._one("look_up", index.graph.table(values))
    return float(values[int(index)])


def _extreme(name: str, of_numbers: Callable) -> Callable[[Any, Any], Any]:
    def apply(a: Any, b: Any) -> Any:
        if isinstance(a, Scalar) and isinstance(b, Scalar):
            return a._two(name, b)
        if isinstance(a, Scalar):
            return a if math.isinf(b) and of_numbers(0.0, b) == 0 else a._one(f"{name}_c", b)
        return apply(b, a) if isinstance(b, Scalar) else of_numbers(a, b)

    return apply


maximum, minimum = _extreme("max", np.maximum), _extreme("min", np.minimum)


def atan2(y: Any, x: Any) -> Any:
    """Return the angle of ``(x, y)``."""
    graph = next((each.graph for each in (y, x) if isinstance(each, Scalar)), None)
    if graph is None:
        return math.atan2(y, x)
    y, x = (each if isinstance(each, Scalar) else graph.make("constant", (), float(each)) for each in (y, x))
    return y._two("atan2", x)


def gradient(graph: Expressions, outputs: Sequence[Any], seeds: Sequence[Any], inputs: Sequence[Scalar]) -> list[Any]:
    """Return the gradient in ``inputs`` of the sum of ``outputs`` times ``seeds``, by one reverse pass."""
    adjoints: dict[int, Any] = {}

    def add(index: int, value: Any) -> None:
        adjoints[index] = adjoints[index] + value if index in adjoints else value

    for output, seed in zip(outputs, seeds, strict=True):
        if isinstance(output, Scalar):
            add(output.index, seed)
    input_indices = {each.index for each in inputs}
    # Only expressions that depend on the inputs have a gradient.
    depends = bytearray(len(graph.nodes))
    for index in input_indices:
        depends[index] = 1
    for index, (_, operands, _) in enumerate(graph.nodes):
        for operand in operands:  # any() would take three times as long
            if depends[operand]:
                depends[index] = 1
                break
    for index in range(len(depends) - 1, -1, -1):
        if index in input_indices or not depends[index] or index not in adjoints:
            continue
        operation, operands, constant = graph.nodes[index]
        vjp, arguments = _VJP[operation], [Scalar(graph, each) for each in operands]
        parts = vjp(adjoints.pop(index), Scalar(graph, index), constant, *arguments)
        for operand, part in zip(operands, parts, strict=True):
            if depends[operand] and (isinstance(part, Scalar) or part != 0):
                add(operand, part)
    return [adjoints.get(each.index, 0.0) for each in inputs]


def _vjp_atan2(g: Any, out: Scalar, c: float, y: Scalar, x: Scalar) -> tuple[Any, Any]:
    scaled = g / (x * x + y * y)
    return x * scaled, -(y * scaled)


# The gradient of each operand, as a function of the result's gradient g, the result, the constant and the operands.
_VJP: dict[str, Callable[..., tuple[Any, ...]]] = {
    "add_c": lambda g, out, c, a: (g,),
    "sub_c": lambda g, out, c, a: (-g,),
    "mul_c": lambda g, out, c, a: (g * c,),
    "div_c": lambda g, out, c, a: (-(g * (out / a)),),
    "sqrt": lambda g, out, c, a: (g * (0.5 / out),),
    "sin": lambda g, out, c, a: (g * cos(a),),
    "cos": lambda g, out, c, a: (-(g * sin(a)),),
    "abs": lambda g, out, c, a: (where(a < 0.0, -g, where(a > 0.0, g, 0.0)),),
    "max_c": lambda g, out, c, a: (where(a < c, 0.0, g),),
    "min_c": lambda g, out, c, a: (where(a > c, 0.0, g),),
    "less_c": lambda g, out, c, a: (0.0,),
    "greater_c": lambda g, out, c, a: (0.0,),
    "equal_c": lambda g, out, c, a: (0.0,),
    "floor": lambda g, out, c, a: (0.0,),
    "look_up": lambda g, out, c, a: (0.0,),
    "add": lambda g, out, c, a, b: (g, g),
    "sub": lambda g, out, c, a, b: (g, -g),
    "mul": lambda g, out, c, a, b: (g * b, g * a),
    "div": lambda g, out, c, a, b: (g / b, -(g / b * out)),
    "atan2": _vjp_atan2,
    "max": lambda g, out, c, a, b: (where(a < b, 0.0, g), where(a < b, g, 0.0)),
    "min": lambda g, out, c, a, b: (where(b < a, 0.0, g), where(b < a, g, 0.0)),
    "less": lambda g, out, c, a, b: (0.0, 0.0),
    "where": lambda g, out, c, condition, a, b: (0.0, where(condition, g, 0.0), where(condition, 0.0, g)),
}
