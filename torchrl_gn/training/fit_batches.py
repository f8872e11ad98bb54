"""Fit a network's predictions to targets by random batches."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchrl_gn.training.optimizers import ScheduledOptimizer


def fit_batches(
    predict: Callable[[Tensor], Tensor],
    inputs: Tensor,
    targets: Tensor,
    optimizer: ScheduledOptimizer,
    *,
    steps: int,
    batch_size: int,
    generator: torch.Generator,
    done: int = 0,
    total: int | None = None,
) -> Tensor:
    """Fit predictions for inputs ``[M, F]`` to targets that broadcast; return the mean squared errors ``[steps]``.

    Args:
        optimizer: of what ``predict`` learns; its schedule is at step ``done`` of ``total``, which is ``steps`` by
            default, when the first begins.
        generator: of the batches, on the inputs' device.

    Raises:
        FloatingPointError: the gradient is not finite; no weight changes at that step.
    """
    losses = []
    for step in range(done, done + steps):
        batch = torch.randint(len(inputs), (batch_size,), generator=generator, device=inputs.device)
        loss = (predict(inputs[batch]) - targets[batch]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step(step, step / (total or steps))
        losses.append(loss.detach())
    return torch.stack(losses) if losses else inputs.new_empty(0)
