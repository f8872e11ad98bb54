"""How well systems are identified: errors with inferred graphs, and what can be read from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_gn.dynamics import Predictor
from torchrl_gn.evaluation.error_table import ErrorTable
from torchrl_gn.evaluation.errors import HORIZONS, evaluate_errors
from torchrl_gn.identification import BoundInferenceModel

_PENALTIES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)  # on squared weights, as shares of the number of samples


@torch.no_grad()
def identification_errors(
    model: Predictor,
    inference: BoundInferenceModel,
    observed: TensorDictBase,
    trajectories: TensorDictBase,
    *,
    steps: int | None = None,
    wrong: bool = False,
    horizons: Sequence[int] = HORIZONS,
    one_step: bool = True,
) -> ErrorTable:
    """Errors of predictions with what was inferred from other trajectories of the same systems.

    Args:
        model: forward model that reads what the inference model writes.
        observed: ``[M]`` with ``state`` ``[M, T + 1, N, 13]`` and ``action`` ``[M, T, A]``: one trajectory of
            every system.
        trajectories: ``[M]`` test trajectories of the same systems in the same order.
        steps: number of transitions to identify from. Default: all.
        wrong: give every system what was inferred of another (paper, figure "System identification performance").
    """
    if len(observed) != len(trajectories):
        raise ValueError(f"There are {len(observed)} observed and {len(trajectories)} test trajectories; give pairs.")
    if wrong and len(observed) < 2:
        raise ValueError("Another system takes at least two trajectories.")
    action = cast(Tensor, observed.get("action"))[:, :steps]
    state = cast(Tensor, observed.get("state"))[:, : action.shape[1] + 1]
    device = next(inference.parameters()).device
    parameters = inference.identify(state.to(device), action.to(device))
    if wrong:
        parameters = parameters.apply(lambda value: value.roll(1, 0))
    entries = {key: trajectories.get(key) for key in ("state", "action")}
    test = TensorDict({**entries, "parameters": parameters}, batch_size=[len(parameters)])
    return evaluate_errors(model, test, horizons=horizons, one_step=one_step)


def linear_probe(features: Tensor, targets: Tensor, *, train: int) -> Tensor:
    """Coefficients of determination ``[P]`` of linear maps from features to targets, on samples not fitted to.

    Ridge regression on standardised features, for each target with the penalty of lowest leave-one-out error.

    Args:
        features: ``[M, F]``.
        targets: ``[M, P]``.
        train: number of samples to fit to; the rest are tested on. At least two each.
    """
    if train < 2 or len(features) - train < 2:
        raise ValueError(f"train={train} of {len(features)} samples leaves too few to fit to or to test on.")
    features, targets = features.double(), targets.double()
    fitted, tested = features[:train], features[train:]
    mean, std = fitted.mean(0), fitted.std(0)
    used = std > 1e-9 * mean.abs().clamp(min=1)
    fitted, tested = ((part[:, used] - mean[used]) / std[used] for part in (fitted, tested))
    center = targets[:train].mean(0)
    wanted = targets[:train] - center
    u, s, v = torch.linalg.svd(fitted, full_matrices=False)
    projected = u.T @ wanted
    best, record = torch.zeros_like(targets[train:]), torch.full_like(center, torch.inf)
    for penalty in _PENALTIES:
        gain = s / (s.square() + penalty * train)
        # The mean is fitted too: one over the number of samples of each one's influence on itself.
        influence = (u.square() * (s * gain)).sum(1, keepdim=True) + 1 / train
        missed = wanted - u @ ((s * gain)[:, None] * projected)
        error = (missed / (1 - influence).clamp(min=1e-9)).square().sum(0)
        predicted = tested @ (v.T @ (gain[:, None] * projected))
        best, record = torch.where(error < record, predicted, best), torch.minimum(error, record)
    left = targets[train:] - center - best
    return 1 - left.square().sum(0) / (targets[train:] - targets[train:].mean(0)).square().sum(0)
