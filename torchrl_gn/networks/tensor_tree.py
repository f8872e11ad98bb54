"""Tensors and modules inside nested tuples and dataclasses, such as folded cores and programs."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

Leaf = Tensor | nn.Module
M = TypeVar("M", bound=nn.Module)


def leaves(value: Any, name: str = "") -> Iterator[tuple[str, Leaf]]:
    """Yield tensors and modules, each with its path as name: ``nodes_mean``, ``core_hidden_0``."""
    if isinstance(value, Leaf):
        yield name, value
        return
    for part, child in _children(value):
        yield from leaves(child, f"{name}_{part}" if name else part)


def skeleton(value: Any) -> Any:
    """Return the nesting of a value without its leaves; :func:`rebuild` restores the value from both."""
    if isinstance(value, Leaf):
        return _LEAF
    children = list(_children(value))
    if not any(True for _ in leaves(value)):
        return _Fixed(value)
    return _Branch(type(value), tuple((name, skeleton(each)) for name, each in children))


def rebuild(tree: Any, given: Iterator[Any]) -> Any:
    """Return the value of a skeleton with ``given`` leaves, in the order of :func:`leaves`."""
    if tree == _LEAF:  # not "is": unpickling makes another object
        return next(given)
    if isinstance(tree, _Fixed):
        return tree.value
    children = {name: rebuild(each, given) for name, each in tree.children}
    return tuple(children.values()) if tree.kind is tuple else tree.kind(**children)


def copy_of(module: M) -> M:
    """Return a deep copy of a module as it is now, with its mode, hooks and all other changes."""
    # PyTorch refuses to copy a tensor that autograd computed, such as a pruned weight: copy these detached.
    attributes = itertools.chain.from_iterable(vars(each).values() for each in module.modules())
    computed = [each for each in attributes if isinstance(each, Tensor) and not each.is_leaf]
    return copy.deepcopy(module, {id(each): each.detach().clone() for each in computed})


def in_dtype(value: Any, dtype: torch.dtype) -> Any:
    """Copy the floating-point numbers of nested tuples and dataclasses in a dtype, detached."""

    def cast(part: Any) -> Any:
        if isinstance(part, Tensor):
            return part.detach().to(dtype, copy=True) if part.is_floating_point() else part
        return copy_of(part).to(dtype).requires_grad_(False)

    return rebuild(skeleton(value), (cast(part) for _, part in leaves(value)))


_LEAF = "leaf"


@dataclass(frozen=True)
class _Fixed:
    value: Any  # without leaves


@dataclass(frozen=True)
class _Branch:
    kind: type
    children: tuple[tuple[str, Any], ...]


def _children(value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, tuple):
        names = getattr(value, "_fields", None) or map(str, range(len(value)))
        yield from zip(names, value, strict=True)
    elif is_dataclass(value) and not isinstance(value, type):
        yield from ((field.name, getattr(value, field.name)) for field in fields(value))
