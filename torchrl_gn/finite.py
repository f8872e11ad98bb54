"""Check that input numbers are finite."""

from __future__ import annotations

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor


def require_finite(value: Tensor | np.ndarray | TensorDictBase, what: str) -> None:
    """Raise ValueError, naming ``what``, value and index, if a number of ``value`` is not finite; waits for a GPU."""
    if torch.compiler.is_compiling():  # compiled code cannot raise on values
        return
    if isinstance(value, TensorDictBase):
        for key, entry in value.items(include_nested=True, leaves_only=True):
            require_finite(entry, f"{what} {key!r}")
        return
    finite = torch.as_tensor(np.isfinite(value)) if isinstance(value, np.ndarray) else torch.isfinite(value)
    if not bool(finite.all()):
        index = tuple((~finite).nonzero()[0].tolist())
        raise ValueError(f"{what} has {float(value[index])} at index {index}; every number must be finite.")
