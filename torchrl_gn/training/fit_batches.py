"""Fitting of a network's predictions to targets on random batches."""

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
    """Fit predictions for inputs ``[M, F]`` to broadcastable targets; return the mean squared errors ``[steps]``.

    Args:
        optimizer: optimiser of the parameters behind ``predict``.
        generator: random generator of the batches, on the inputs' device.
        done: steps of the optimiser's schedule taken before.
        total: steps of the whole schedule; default: ``steps``.

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
