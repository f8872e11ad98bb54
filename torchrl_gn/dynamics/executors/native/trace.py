"""Trace torch functions of one sample to scalar expressions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch._decomp import decomposition_table
from torch.utils._pytree import tree_map_only

from torchrl_gn.dynamics.executors.native.expressions import UntraceableError
from torchrl_gn.dynamics.executors.native.operations import OPERATIONS, PRODUCTS, Array, as_object, to_array


def trace(function: Callable[..., tuple[Tensor, ...]], *inputs: Array) -> list[Array]:
    """Return the results of a function of float64 tensors as arrays of expressions and numbers.

    ``inputs`` are arrays of expressions and numbers, in the shapes of the function's arguments.

    Raises:
        UntraceableError: if an operation has no scalar form; the message names it.
    """
    try:
        with torch.no_grad():
            return [to_array(_unwrapped(each)) for each in function(*map(_Symbolic, inputs))]
    except UntraceableError:
        raise
    except Exception as error:  # a user's feature may fail in any way on a tensor without numbers
        raise UntraceableError(f"The state maths has no scalar form: {type(error).__name__}: {error}") from error


class _Symbolic(Tensor):
    """Tensor of expressions: operations work on its array. Operations without expressions run in torch."""

    array: Array

    @staticmethod
    def __new__(cls, array: Array, dtype: torch.dtype = torch.float64) -> _Symbolic:
        tensor = Tensor._make_wrapper_subclass(cls, array.shape, dtype=dtype)  # pyright: ignore[reportAttributeAccessIssue]
        tensor.array = array
        return tensor

    def __init__(self, *args: Any) -> None:
        pass

    @classmethod
    def __torch_function__(cls, function: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        if function in PRODUCTS:  # torch would decompose these into in-place operations
            return _Symbolic(PRODUCTS[function](*tree_map_only(_Symbolic, _unwrapped, args), **(kwargs or {})))
        return torch._C._disabled_torch_function_impl(function, types, args, kwargs or {})

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        kwargs, name = dict(kwargs or {}), function._schema.name.removeprefix("aten::")
        if name in OPERATIONS:
            args = tree_map_only(_Symbolic, _unwrapped, args)
            kwargs = {key: _unwrapped(value) for key, value in kwargs.items()}
            try:
                out = OPERATIONS[name](*args, **kwargs)
                # NumPy returns a result without dimensions as a bare object, not an array.
                out = out if isinstance(out, (Tensor, tuple, list)) else as_object(out)
            except NotImplementedError as error:
                raise UntraceableError(f"The operation {function} has no scalar form here: {error}.") from error
            dtype = torch.bool if name in ("lt", "gt", "eq") else torch.float64
            return tree_map_only(np.ndarray, lambda array: _Symbolic(array, dtype), out)
        out = (decomposition_table.get(function) or function.decompose)(*args, **kwargs)
        if out is NotImplemented:
            raise UntraceableError(f"The operation {function} has no scalar form.")
        return out


def _unwrapped(tensor: Any) -> Any:
    return tensor.array if isinstance(tensor, _Symbolic) else tensor
