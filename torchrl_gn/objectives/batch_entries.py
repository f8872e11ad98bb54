"""Read what a loss needs from a batch."""

from __future__ import annotations

from collections.abc import Iterable

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_gn.finite import require_finite


def read_entries(loss: nn.Module, tensordict: TensorDictBase, keys: Iterable[NestedKey]) -> list[Tensor]:
    """Entries of a batch, in the order of ``keys``.

    Raises:
        KeyError: if an entry is missing, naming the loss.
        ValueError: if a value is NaN or Inf.
    """
    values = []
    for key in keys:
        value = tensordict.get(key, None)
        if value is None:
            present = sorted(map(str, tensordict.keys(True)))
            raise KeyError(f"{type(loss).__name__} needs {key!r}, the batch has {present}.")
        require_finite(value, f"{key!r} of the batch")
        values.append(value)
    return values
