"""Torch's operations on arrays of scalar expressions."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.dynamics.executors.native import expressions as ex

Array = np.ndarray  # of objects: expressions and numbers


def to_array(value: Any) -> Array:
    """Convert a tensor or number to an array of objects."""
    if isinstance(value, np.ndarray):
        return value
    if not isinstance(value, Tensor):
        value = torch.as_tensor(value, dtype=torch.float64)
    array = np.empty(tuple(value.shape), dtype=object)
    array[...] = value.numpy(force=True).astype(object)
    return array


def _elementwise(function: Callable, arity: int) -> Callable:
    vectorized = np.frompyfunc(function, arity, 1)

    def apply(*args: Any, **kwargs: Any) -> Array:
        return as_object(vectorized(*map(to_array, args[:arity])))

    return apply


def as_object(value: Any) -> Array:
    """Convert one expression or number to an array without dimensions; return arrays unchanged."""
    if isinstance(value, np.ndarray):
        return value
    array = np.empty((), dtype=object)
    array[()] = value
    return array


def _add(sign: int) -> Callable:
    def apply(a: Any, b: Any, *, alpha: float = 1) -> Array:
        return as_object(to_array(a) + to_array(b) * (sign * alpha))

    return apply


def _mul(a: Any, b: Any) -> Array:
    if not isinstance(b, (Tensor, np.ndarray)) and b == 0:
        return as_object(np.frompyfunc(ex.zero_times, 1, 1)(a))
    return as_object(to_array(a) * to_array(b))


def _pow(a: Array, exponent: float) -> Array:
    if exponent == 0.5:
        return _elementwise(ex.sqrt, 1)(a)
    if exponent != int(exponent) or exponent < 1:
        raise NotImplementedError(f"exponent {exponent}")
    out = a
    for _ in range(int(exponent) - 1):
        out = as_object(out * a)
    return out


def _clamp(a: Array, low: Any = None, high: Any = None) -> Array:
    out = a
    if low is not None:
        out = _elementwise(ex.maximum, 2)(out, low)
    return out if high is None else _elementwise(ex.minimum, 2)(out, high)


def _axes(a: Array, dims: Sequence[int] | int | None) -> tuple[int, ...]:
    if dims is None or (not isinstance(dims, int) and not len(dims)):
        return tuple(range(a.ndim))
    return tuple(d % a.ndim for d in ((dims,) if isinstance(dims, int) else dims))


def _reduce(function: Callable, a: Array, dims: Any, keepdim: bool) -> Array:
    axes = _axes(a, dims)
    kept_axes = [d for d in range(a.ndim) if d not in axes]
    rows = a.transpose(*kept_axes, *axes).reshape(*(a.shape[d] for d in kept_axes), -1)
    out = np.empty(rows.shape[:-1], dtype=object)
    for where in np.ndindex(out.shape):
        out[where] = function(rows[where])
    return out.reshape([1 if d in axes else size for d, size in enumerate(a.shape)]) if keepdim else out


def _sum(values: Sequence[Any]) -> Any:
    total: Any = 0.0
    for value in values:
        total = total + value
    return total


def _maximum(values: Sequence[Any]) -> Any:
    largest = values[0]
    for value in values[1:]:
        largest = ex.maximum(largest, value)
    return largest


def _norm(a: Array, order: float = 2, dim: Any = None, keepdim: bool = False, **kwargs: Any) -> Array:
    if order != 2:
        raise NotImplementedError(f"norm of order {order}")
    return _reduce(lambda row: ex.sqrt(_sum([x * x for x in row])), a, dim, keepdim)


def _matmul(a: Any, b: Any) -> Array:
    a, b = to_array(a), to_array(b)
    return as_object(np.matmul(a, b)) if a.size and b.size else np.full((*a.shape[:-1], b.shape[-1]), 0.0, dtype=object)


def _solve(a: Any, b: Any, **kwargs: Any) -> tuple[Array, ...]:
    """Solve symmetric positive definite systems by L D L^T; all systems of the state maths are of this kind.

    Other systems give wrong results, which the comparison of every trace with torch detects.
    """
    a, b = to_array(a), to_array(b)
    vector = b.ndim == 1 or b.shape == a.shape[:-1]
    b = b[..., None] if vector else b
    batch = np.broadcast_shapes(a.shape[:-2], b.shape[:-2])
    a, b = np.broadcast_to(a, (*batch, *a.shape[-2:])), np.broadcast_to(b, (*batch, *b.shape[-2:]))
    out = np.empty(b.shape, dtype=object)
    for where in np.ndindex(a.shape[:-2]):
        out[where] = _solve_one(a[where], b[where])
    out = out[..., 0] if vector else out
    return out, out, out, torch.zeros(a.shape[:-2], dtype=torch.int32)  # pyright: ignore[reportReturnType]


def _solve_one(matrix: Array, right: Array) -> Array:
    size = len(matrix)
    lower, scaled = np.full((size, size), 0.0, dtype=object), np.full((size, size), 0.0, dtype=object)
    inverse = np.full(size, 0.0, dtype=object)
    for i in range(size):
        for j in range(i + 1):
            value = matrix[i, j] - _sum([scaled[i, k] * lower[j, k] for k in range(j)])
            if i == j:
                inverse[i] = 1.0 / value
            else:
                scaled[i, j] = value
                lower[i, j] = value * inverse[j]
    x = np.array(right, dtype=object)
    for i in range(size):
        for k in range(i):
            x[i] = x[i] - x[k] * lower[i, k]
    x = x * inverse[:, None]
    for i in reversed(range(size)):
        for k in range(i + 1, size):
            x[i] = x[i] - x[k] * lower[k, i]
    return x


def _slice(a: Array, dim: int = 0, start: int | None = None, end: int | None = None, step: int = 1) -> Array:
    return a[(slice(None),) * (dim % a.ndim) + (slice(start, end, step),)]


def _index(a: Any, indices: Sequence[Any]) -> Array:
    if any(isinstance(each, np.ndarray) for each in indices):
        if isinstance(a, np.ndarray) or a.ndim != 1:
            raise NotImplementedError("varying indices of anything but a list of constants")
        values = a.numpy(force=True)
        return as_object(np.frompyfunc(lambda index: ex.look_up(values, index), 1, 1)(indices[0]))
    keys = tuple(slice(None) if each is None else np.asarray(each.numpy(force=True)) for each in indices)
    return as_object(to_array(a)[keys])


def _cat(parts: Sequence[Any], dim: int = 0) -> Array:
    return np.concatenate([to_array(each) for each in parts], axis=dim)


def _split(a: Array, sizes: Sequence[int], dim: int = 0) -> list[Array]:
    return np.split(a, np.cumsum(sizes)[:-1], axis=dim)


def _expand(a: Array, sizes: Sequence[int], **kwargs: Any) -> Array:
    missing = len(sizes) - a.ndim
    shape = [a.shape[d - missing] if size == -1 else size for d, size in enumerate(sizes)]
    return np.broadcast_to(a, shape)


def _squeeze(a: Array, dims: Any = None) -> Array:
    axes = tuple(d for d in _axes(a, dims) if a.shape[d] == 1)
    return np.squeeze(a, axis=axes)


def _unsqueeze(a: Array, dim: int) -> Array:
    return np.expand_dims(a, dim)


def _pad(a: Array, pad: Sequence[int], value: float = 0.0) -> Array:
    widths = [(0, 0)] * a.ndim
    for index in range(len(pad) // 2):
        widths[a.ndim - 1 - index] = (pad[2 * index], pad[2 * index + 1])
    return np.pad(a, widths, constant_values=value)


def _filled(a: Array, value: float) -> Tensor:
    return torch.full(a.shape, float(value), dtype=torch.float64)


def _same(a: Array, *args: Any, **kwargs: Any) -> Array:
    return a


def _linear(a: Any, weight: Any, bias: Any = None) -> Array:
    out = _matmul(a, to_array(weight).T)
    return out if bias is None else as_object(out + to_array(bias))


PRODUCTS: dict[Any, Callable[..., Array]] = {
    torch.matmul: _matmul,
    Tensor.matmul: _matmul,
    Tensor.__matmul__: _matmul,
    Tensor.__rmatmul__: lambda a, b: _matmul(b, a),
    torch.nn.functional.linear: _linear,
}
OPERATIONS: dict[str, Callable[..., Any]] = {
    "getitem": operator.getitem,
    "add": _add(1),
    "sub": _add(-1),
    "rsub": lambda a, b, alpha=1: _add(-1)(b, a, alpha=alpha),
    "mul": _mul,
    "div": _elementwise(ex.divide, 2),
    "neg": lambda a: -a,
    "reciprocal": lambda a: _elementwise(ex.divide, 2)(1.0, a),
    "pow": _pow,
    "sqrt": _elementwise(ex.sqrt, 1),
    "sin": _elementwise(ex.sin, 1),
    "cos": _elementwise(ex.cos, 1),
    "floor": _elementwise(ex.floor, 1),
    "atan": lambda a: _elementwise(ex.atan2, 2)(a, 1.0),
    "abs": _elementwise(ex.absolute, 1),
    "atan2": _elementwise(ex.atan2, 2),
    "maximum": _elementwise(ex.maximum, 2),
    "minimum": _elementwise(ex.minimum, 2),
    "clamp": _clamp,
    "clamp_min": lambda a, low: _clamp(a, low),
    "where": _elementwise(ex.where, 3),
    "lt": _elementwise(operator.lt, 2),
    "gt": _elementwise(operator.gt, 2),
    "eq": _elementwise(operator.eq, 2),
    "sum": lambda a, dims=None, keepdim=False, **_: _reduce(_sum, a, dims, keepdim),
    "mean": lambda a, dims=None, keepdim=False, **_: _reduce(lambda row: _sum(row) / len(row), a, dims, keepdim),
    "amax": lambda a, dims=None, keepdim=False: _reduce(_maximum, a, dims, keepdim),
    "linalg_vector_norm": _norm,
    "mm": _matmul,
    "bmm": _matmul,
    "_linalg_solve_ex": _solve,
    "view": lambda a, shape: a.reshape(shape),
    "permute": lambda a, dims: a.transpose(dims),
    "expand": _expand,
    "squeeze": _squeeze,
    "unsqueeze": _unsqueeze,
    "slice": _slice,
    "select": lambda a, dim, index: as_object(np.take(a, index, axis=dim)),
    "index_select": lambda a, dim, index: as_object(np.take(to_array(a), index.numpy(force=True), axis=dim)),
    "index": _index,
    "cat": _cat,
    "split_with_sizes": _split,
    "constant_pad_nd": _pad,
    "diagonal": lambda a, offset=0, dim1=0, dim2=1: np.diagonal(a, offset, dim1, dim2),
    "full_like": lambda a, value, **_: _filled(a, value),
    "alias": _same,
    "clone": _same,
    "copy": lambda a, b, *_: np.broadcast_to(to_array(b), a.shape),
    "_to_copy": _same,
    "lift_fresh_copy": _same,
}
