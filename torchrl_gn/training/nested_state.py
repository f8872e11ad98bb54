"""Nested training state as tensors by name and a plain mirror of the structure, which may be untrusted."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, cast

from torch import Tensor


def flatten(value: Any, prefix: str, tensors: dict[str, Tensor]) -> Any:
    """Return a plain mirror of a nested structure, and add its tensors to ``tensors`` by name."""
    if isinstance(value, Tensor):
        while prefix in tensors:  # of {"a.b": ...} beside {"a": {"b": ...}}, or of 1 beside "1"
            prefix += "'"
        tensors[prefix] = value
        return {"tensor": prefix}
    if isinstance(value, Mapping):
        for key in value:
            if not (key is None or isinstance(key, (bool, int, float, str))):
                raise TypeError(f"Checkpoint entry {prefix} has the key {key!r}; only texts and numbers fit.")
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


def require_like(own: Any, saved: Any, name: str = "training") -> None:
    """Raise ValueError, naming the entry, if ``saved`` differs from ``own`` in keys, types or shapes of tensors.

    In ``own``, None accepts anything, an empty dictionary any dictionary, and an empty list any number of numbers. Keys
    that ``own`` lacks are ignored.
    """
    if own is None:
        return
    if isinstance(own, Tensor):
        fits = isinstance(saved, Tensor) and saved.shape == own.shape
        fits = fits and (saved.dtype == own.dtype or saved.is_floating_point() and own.is_floating_point())
        what = f"a tensor {list(own.shape)} of {own.dtype}"
    elif isinstance(own, Mapping):
        fits, what = isinstance(saved, Mapping) and own.keys() <= saved.keys(), f"a dictionary of {list(own)}"
    elif isinstance(own, (list, tuple)):
        fits = isinstance(saved, (list, tuple)) and (len(saved) == len(own) or not own and all(map(_is_number, saved)))
        what = f"a list of {len(own) or 'numbers'}"
    elif _is_number(own):
        fits = _is_number(saved) and math.isfinite(saved) and (isinstance(own, float) or isinstance(saved, int))
        what = f"a finite {type(own).__name__}"
    else:
        fits, what = type(saved) is type(own), f"a {type(own).__name__}"
    if not fits:
        raise ValueError(f"{name} is not {what}")
    items = own.items() if isinstance(own, Mapping) else enumerate(own) if isinstance(own, (list, tuple)) else ()
    for key, value in items:
        require_like(value, cast(Any, saved)[key], f"{name}.{key}")


def require_amounts(amounts: Mapping[str, Any], name: str = "training.progress") -> None:
    """Raise ValueError if a number in a nested dictionary is below 0; None is allowed."""
    for key, value in amounts.items():
        if isinstance(value, Mapping):
            require_amounts(value, f"{name}.{key}")
        elif value is not None and value < 0:
            raise ValueError(f"{name}.{key} is below 0")


def _is_number(value: Any) -> bool:
    return type(value) is float or type(value) is int and abs(value) < 2**63
