"""Checks of a loss's inputs: entries of a batch, and fitted normalisers."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.finite import is_traced, require_all_finite
from torchrl_gn.policies import ObservationModel, ObservationNetwork


def read_entries(loss: nn.Module, tensordict: TensorDictBase, keys: Iterable[NestedKey]) -> list[Tensor]:
    """Return entries of a batch in the order of ``keys``; KeyError if one is missing, ValueError if NaN or Inf."""
    values = {}
    for key in keys:
        value = tensordict.get(key, None)
        if value is None:
            present = sorted(map(str, tensordict.keys(True)))
            raise KeyError(f"{type(loss).__name__} needs {key!r}, the batch has {present}.")
        values[f"{key!r} of the batch"] = value
    require_all_finite(values)
    return list(values.values())


def require_fitted(loss: Any, *networks: nn.Module, remedy: str, also: Callable[[], None] | None = None) -> None:
    """Raise RuntimeError, with a ``remedy``, if normalisers of the loss's networks have seen no data.

    Reading statistics waits for the device. So a loss checks only until it has passed once, and not while it is
    compiled or in a transform of ``torch.func``: call it once before. ``also`` is a second check, which raises its own
    error.
    """
    if getattr(loss, "_fitted", False) or is_traced():
        return
    for part in (part for network in networks for part in network.modules()):
        if isinstance(part, (ForwardModel, ObservationModel, ObservationNetwork)) and not part.fitted:
            raise RuntimeError(
                f"{type(loss).__name__}: normalisers of its {type(part).__name__} have seen no data, so it would"
                f" read zeros. {remedy}"
            )
    if also is not None:
        also()
    loss._fitted = True
