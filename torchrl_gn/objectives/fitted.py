"""Refuse to train with normalisers that have seen no data: a network would read zeros."""

from __future__ import annotations

from torch import nn

from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.policies import ObservationModel, ObservationNetwork


def require_fitted(loss: nn.Module, *networks: nn.Module, remedy: str) -> None:
    """Refuse networks whose normalisers have seen no data, here or in the training that their weights come from.

    Reading statistics waits for the device, so a loss asks until it passed once, and not while it is compiled:
    compile a loss after its first call.

    Args:
        loss: the loss, to name it.
        *networks: what it trains or reads, with models of ours anywhere in them.
        remedy: what to call, with what.

    Raises:
        RuntimeError: if the normalisers of one have seen no data.
    """
    for network in networks:
        for part in network.modules():
            if isinstance(part, (ForwardModel, ObservationModel, ObservationNetwork)) and not part.fitted:
                raise RuntimeError(
                    f"{type(loss).__name__}: normalisers of its {type(part).__name__} have seen no data, so it would"
                    f" read zeros. {remedy}"
                )
