"""Input checks for real and finite tensors; where code cannot branch on values, finiteness is not checked."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor


def is_traced() -> bool:
    """Return True while a compiler or ``torch.func`` transform traces the code, which then cannot branch on values."""
    return torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active()


def _may_ask() -> bool:
    """Return True if code may branch on values: it is neither traced nor recorded as a CUDA graph."""
    recorded = torch.cuda.is_initialized() and torch.cuda.is_current_stream_capturing()
    return not (recorded or is_traced())


def require_real(value: object, what: str, *, whole: bool = True) -> None:
    """Raise TypeError, naming ``what``, unless ``value`` is a tensor of real numbers; ``whole`` allows integers."""
    if not isinstance(value, Tensor):
        kind = f"{type(value).__module__}.{type(value).__name__}".removeprefix("builtins.")
        raise TypeError(f"{what} must be a tensor, not {kind}: convert it with torch.as_tensor().")
    if value.dtype == torch.bool or value.is_complex():
        raise TypeError(f"{what} must be real numbers, not {str(value.dtype).removeprefix('torch.')}.")
    if not (whole or value.is_floating_point()):
        kind = str(value.dtype).removeprefix("torch.")
        raise TypeError(f"{what} must be floating-point numbers, not {kind}: convert it with double().")


def require_finite(value: Tensor | np.ndarray | TensorDictBase, what: str) -> None:
    """Raise ValueError, naming ``what``, number and index, if ``value`` is not finite; synchronises a GPU."""
    if not _may_ask():
        return
    if isinstance(value, TensorDictBase):
        for key, entry in value.items(include_nested=True, leaves_only=True):
            require_finite(entry, f"{what} {key!r}")
        return
    finite = torch.as_tensor(np.isfinite(value)) if isinstance(value, np.ndarray) else torch.isfinite(value)
    if not bool(finite.all()):
        index = tuple((~finite).nonzero()[0].tolist())
        raise ValueError(f"{what} has {float(value[index])} at index {index}; every number must be finite.")


def require_all_finite(values: Mapping[str, Tensor]) -> None:
    """Call :func:`require_finite` for each value by its name; synchronises a device once if all are finite."""
    if not _may_ask():
        return
    elsewhere = [value for value in values.values() if not value.is_cpu]
    if elsewhere and bool(torch.stack([torch.isfinite(value).all() for value in elsewhere]).all()):
        values = {what: value for what, value in values.items() if value.is_cpu}
    for what, value in values.items():
        require_finite(value, what)
