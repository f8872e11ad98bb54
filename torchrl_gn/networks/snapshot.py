"""Copies of folded networks that share no memory with the weights."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchrl_gn.networks.core import Core


def _map(value: Any, function: Callable[[Tensor], Tensor], dtype: torch.dtype) -> Any:
    """The same nested tuples and dataclasses with ``function`` on every floating-point tensor."""
    if isinstance(value, Tensor):
        return function(value) if value.is_floating_point() else value
    if isinstance(value, Core):
        return copy.deepcopy(value).to(dtype).requires_grad_(False)
    if isinstance(value, tuple):
        return tuple(_map(entry, function, dtype) for entry in value)
    if is_dataclass(value) and not isinstance(value, type):
        changed = {field.name: _map(getattr(value, field.name), function, dtype) for field in fields(value)}
        return replace(value, **changed)
    return value


def snapshot(folded: Any, dtype: torch.dtype) -> Any:
    """Copy of a folded network in ``dtype`` that shares no memory and passes no gradient to the weights."""

    def copied(tensor: Tensor) -> Tensor:
        return tensor.detach().to(dtype).clone(memory_format=torch.contiguous_format)

    return _map(folded, copied, dtype)


def copy_into(old, new) -> bool:
    """Overwrite the tensors of nested tuples and dataclasses, if all else is equal; whether it was."""
    pairs = _pairs(old, new)
    if pairs is None:
        return False
    with torch.no_grad():
        for a, b in pairs:
            a.copy_(b)
    return True


def same(old, new) -> bool:
    """Whether nested tuples and dataclasses hold equal tensors, and all else is equal."""
    pairs = _pairs(old, new)
    return pairs is not None and all(a is b or torch.equal(a, b) for a, b in pairs)


def _pairs(old, new) -> list[tuple[Tensor, Tensor]] | None:
    """Tensors of the same places, shapes, dtypes and devices; None if anything else differs."""
    pairs: list[tuple[Tensor, Tensor]] = []

    def collect(a, b) -> bool:
        if type(a) is not type(b):
            return False
        if isinstance(a, Tensor):
            pairs.append((a, b))
            return (a.shape, a.dtype, a.device) == (b.shape, b.dtype, b.device)
        if isinstance(a, Core):
            tensors = ((*core.parameters(), *core.buffers()) for core in (a, b))
            return repr(a) == repr(b) and collect(*tensors)
        if isinstance(a, tuple):
            return len(a) == len(b) and all(map(collect, a, b))
        if is_dataclass(a):
            return all(collect(getattr(a, field.name), getattr(b, field.name)) for field in fields(a))
        return a == b

    return pairs if collect(old, new) else None
