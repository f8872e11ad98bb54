"""Refuse to train with normalisers that have seen no data: a network would read zeros."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import nn

from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.policies import ObservationModel, ObservationNetwork


def require_fitted(loss: Any, *networks: nn.Module, remedy: str, also: Callable[[], None] | None = None) -> None:
    """Raise RuntimeError, with a ``remedy``, if normalisers of the loss's networks have seen no data.

    Reading statistics waits for the device, so a loss checks until it passes once, and never while being compiled:
    compile it after its first call. ``also`` is a second check, which raises its own error.
    """
    if getattr(loss, "_fitted", False) or torch.compiler.is_compiling():
        return
    for network in networks:
        for part in network.modules():
            if isinstance(part, (ForwardModel, ObservationModel, ObservationNetwork)) and not part.fitted:
                raise RuntimeError(
                    f"{type(loss).__name__}: normalisers of its {type(part).__name__} have seen no data, so it would"
                    f" read zeros. {remedy}"
                )
    if also is not None:
        also()
    loss._fitted = True
