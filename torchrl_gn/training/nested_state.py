"""Nested training state as tensors by name and a plain mirror of the structure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor


def flatten(value: Any, prefix: str, tensors: dict[str, Tensor]) -> Any:
    """Plain mirror of a nested structure in which each tensor is replaced by its name."""
    if isinstance(value, Tensor):
        tensors[prefix] = value
        return {"tensor": prefix}
    if isinstance(value, Mapping):
        return {"dict": [[key, flatten(item, f"{prefix}.{key}", tensors)] for key, item in value.items()]}
    if isinstance(value, (list, tuple)):
        return {"list": [flatten(item, f"{prefix}.{index}", tensors) for index, item in enumerate(value)]}
    if value is None or isinstance(value, (bool, int, float, str)):
        return {"value": value}
    raise TypeError(f"Checkpoint entry {prefix} has type {type(value).__name__}; only tensors and plain values fit.")


def unflatten(mirror: Any, tensors: Mapping[str, Tensor]) -> Any:
    """Undo :func:`flatten`."""
    if "tensor" in mirror:
        return tensors[mirror["tensor"]]
    if "dict" in mirror:
        return {key: unflatten(item, tensors) for key, item in mirror["dict"]}
    if "list" in mirror:
        return [unflatten(item, tensors) for item in mirror["list"]]
    return mirror["value"]
