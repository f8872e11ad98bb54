"""Evaluation of a trained model in one call, and of system identification."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_gn.checks import check_count, check_counts, checked_seed
from torchrl_gn.data import collect_trajectories
from torchrl_gn.dynamics import BoundEnsemble, ForwardModel, Predictor
from torchrl_gn.evaluation.error_table import ErrorTable
from torchrl_gn.evaluation.errors import HORIZONS, evaluate_errors
from torchrl_gn.evaluation.figures import plot_errors
from torchrl_gn.evaluation.motion_figures import plot_band, plot_body_trajectory
from torchrl_gn.evaluation.video import rollout_video
from torchrl_gn.finite import require_finite
from torchrl_gn.identification import BoundInferenceModel, IdentifyingModel
from torchrl_gn.networks.evaluation_mode import evaluation_mode
from torchrl_gn.scenes import Scene, require_bodies, sample_variants
from torchrl_gn.scenes.checked_trajectories import check_trajectories

_PENALTIES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)  # on squared weights, as shares of the number of samples


def report(
    model: Predictor | BoundEnsemble,
    trajectories: TensorDictBase,
    folder: str | os.PathLike,
    *,
    horizons: tuple[int, ...] = HORIZONS,
    scene: Scene | None = None,
) -> tuple[ErrorTable, list[Path]]:
    """Evaluate a model on trajectories ``[M]``, and draw the first.

    ``scene`` is the scene of the first trajectory, for example a variant. Default: the model's scene.

    Returns the error table and the written files: ``prediction.png`` (one body, with a calibrated ensemble's standard
    deviations), ``errors.png`` and ``rollout.gif``.
    """
    folder, scene = Path(folder), scene or require_bodies(model.scene, "report")
    table = evaluate_errors(model, trajectories, horizons=horizons, keep=1)
    prediction = table.rollouts[0]
    prediction = prediction[: int(prediction.isfinite().flatten(1).all(1).long().cumprod(0).sum())]
    truth = trajectories["state"][0, : len(prediction)]
    if isinstance(model, BoundEnsemble) and model.calibration.fitted:
        state, action = (cast(Tensor, trajectories[name])[0].to(model.counted.device) for name in ("state", "action"))
        with torch.no_grad(), evaluation_mode(model):
            std = model.predict(state[0], action[: len(truth) - 1]).std.cpu()
        drawn = plot_band(truth, prediction, std, scene, folder / "prediction.png")
    else:
        drawn = plot_body_trajectory(truth, prediction, scene, folder / "prediction.png")
    files = [
        drawn,
        plot_errors({scene.name: table}, folder / "errors.png"),
        rollout_video(scene, truth, prediction, folder / "rollout.gif", speed=min(1.0, scene.timestep / 0.01)),
    ]
    return table, files


def fresh_errors(
    model: ForwardModel | IdentifyingModel,
    scene: Scene,
    *,
    sequences: int,
    length: int,
    seed: int,
    context_length: int = 20,
) -> ErrorTable:
    """Evaluate a model on new random trajectories of a scene, of at least 100 control steps.

    An identifying model is evaluated on random variants: it identifies each from the first ``context_length`` steps of
    one trajectory, and predicts another.
    """
    if length < max(HORIZONS):
        raise ValueError(f"length={length} is too short: errors are measured over rollouts of {max(HORIZONS)} steps.")
    if isinstance(model, ForwardModel):
        trajectories = collect_trajectories(scene, sequences, length, seed, split=3)
        return evaluate_errors(model.bind(scene), trajectories)
    rng = np.random.default_rng(np.random.SeedSequence(checked_seed(seed), spawn_key=(5,)))
    variants = sample_variants(scene.origin.get("system", scene.name), sequences, rng)
    both = collect_trajectories(variants, 2 * sequences, length, seed, split=4)
    observed, predicted = (cast(TensorDictBase, half) for half in (both[:sequences], both[sequences:]))
    return identification_errors(*model.bind(scene), observed, predicted, steps=context_length)


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
    """Return the errors of predictions with parameters inferred from other trajectories of the same systems.

    Args:
        model: forward model that reads the inference model's estimates.
        observed: ``[M]`` with ``state`` ``[M, T + 1, N, 13]`` and ``action`` ``[M, T, A]``: one trajectory of
            every system.
        trajectories: ``[M]`` test trajectories of the same systems in the same order.
        steps: number of transitions to identify from. Default: all.
        wrong: give every system the estimate of another (paper, figure "System identification performance").

    Raises:
        ValueError: if there are no pairs, ``steps`` is below 1, or trajectories are not finite, or of another control
            step or shape.
    """
    if len(observed) != len(trajectories):
        raise ValueError(
            f"Got {len(observed)} observed and {len(trajectories)} test trajectories; give one pair per system."
        )
    if steps is not None:
        check_count("steps", steps, 1)
    if wrong and len(observed) < 2:
        raise ValueError("wrong=True needs trajectories of at least two systems.")
    for each in (observed, trajectories):
        check_trajectories(each, model.scene, layout=model.layout)
    action = cast(Tensor, observed.get("action"))[:, :steps]
    state = cast(Tensor, observed.get("state"))[:, : action.shape[1] + 1]
    device = next(inference.parameters()).device
    with evaluation_mode(inference):
        parameters = inference.identify(state.to(device), action.to(device))
    if wrong:
        parameters = parameters.apply(lambda value: value.roll(1, 0))
    entries = {key: trajectories.get(key) for key in ("state", "action")}
    test = TensorDict({**entries, "parameters": parameters}, batch_size=[len(parameters)])
    return evaluate_errors(model, test, horizons=horizons, one_step=one_step)


def linear_probe(features: Tensor, targets: Tensor, *, train: int) -> Tensor:
    """Return coefficients of determination ``[P]`` of linear maps from features ``[M, F]`` to targets ``[M, P]``.

    The maps are ridge regressions on standardised features; each target has the penalty of lowest leave-one-out error.
    They are fitted to the first ``train`` samples and tested on the rest; each part needs at least two samples. The
    coefficient of a target that does not vary in the test is NaN.

    Raises:
        ValueError: if a part has fewer samples, or a number is not finite.
    """
    check_counts(train=train)
    require_finite(features, "features")
    require_finite(targets, "targets")
    if train < 2 or len(features) - train < 2:
        raise ValueError(f"train={train} of {len(features)} samples leaves too few to fit to or to test on.")
    features, targets = features.double(), targets.double()
    fitted, tested = features[:train], features[train:]
    mean, std = fitted.mean(0), fitted.std(0)
    used = std > 1e-9 * mean.abs().clamp(min=1)
    fitted, tested = ((part[:, used] - mean[used]) / std[used] for part in (fitted, tested))
    center = targets[:train].mean(0)
    centered = targets[:train] - center
    u, s, v = torch.linalg.svd(fitted, full_matrices=False)
    projected = u.T @ centered
    best, record = torch.zeros_like(targets[train:]), torch.full_like(center, torch.inf)
    for penalty in _PENALTIES:
        gain = s / (s.square() + penalty * train)
        # 1 / train is the fitted mean's influence.
        influence = (u.square() * (s * gain)).sum(1, keepdim=True) + 1 / train
        missed = centered - u @ ((s * gain)[:, None] * projected)
        error = (missed / (1 - influence).clamp(min=1e-9)).square().sum(0)
        predicted = tested @ (v.T @ (gain[:, None] * projected))
        best, record = torch.where(error < record, predicted, best), torch.minimum(error, record)
    left = targets[train:] - center - best
    varied = (targets[train:] - targets[train:].mean(0)).square().sum(0)
    return torch.where(varied > 0, 1 - left.square().sum(0) / varied, torch.nan)
