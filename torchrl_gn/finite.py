"""Refuse NaN and infinity where numbers come in, before they spread."""

from __future__ import annotations

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor


def require_finite(value: Tensor | np.ndarray | TensorDictBase, what: str) -> None:
    """Raise where a number is NaN or infinite.

    Waits for a GPU, so it stands where a user's numbers enter and never between steps. ``torch.compile`` leaves it out:
    a compiled function cannot stop halfway.

    Args:
        value: any shape; of a TensorDict every entry.
        what: what it is, for the message.

    Raises:
        ValueError: naming what it is, the number and its index.
    """
    if torch.compiler.is_compiling():
        return
    if isinstance(value, TensorDictBase):
        for key, entry in value.items(include_nested=True, leaves_only=True):
            require_finite(entry, f"{what} {key!r}")
        return
    finite = torch.as_tensor(np.isfinite(value)) if isinstance(value, np.ndarray) else torch.isfinite(value)
    if not bool(finite.all()):
        index = tuple((~finite).nonzero()[0].tolist())
        raise ValueError(f"{what} has {float(value[index])} at index {index}; every number must be finite.")
