"""Check that input numbers are finite, where code may branch on numbers."""

from __future__ import annotations

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor


def is_traced() -> bool:
    """Whether a compiler or a transform of ``torch.func`` runs the code, which cannot branch on numbers."""
    return torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active()


def require_finite(value: Tensor | np.ndarray | TensorDictBase, what: str) -> None:
    """Raise ValueError, naming ``what``, value and index, if a number of ``value`` is not finite; waits for a GPU."""
    if is_traced():
        return
    if isinstance(value, TensorDictBase):
        for key, entry in value.items(include_nested=True, leaves_only=True):
            require_finite(entry, f"{what} {key!r}")
        return
    finite = torch.as_tensor(np.isfinite(value)) if isinstance(value, np.ndarray) else torch.isfinite(value)
    if not bool(finite.all()):
        index = tuple((~finite).nonzero()[0].tolist())
        raise ValueError(f"{what} has {float(value[index])} at index {index}; every number must be finite.")
