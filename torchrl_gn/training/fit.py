"""Training of a forward model, or an ensemble, in one call."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import torch
from tensordict import TensorDictBase
from torch import nn
from tqdm import tqdm

from torchrl_gn.checks import checked_seed
from torchrl_gn.data import trajectory_buffer
from torchrl_gn.dynamics import BoundEnsemble, BoundPredictor
from torchrl_gn.evaluation import evaluate_errors
from torchrl_gn.evaluation.errors import check_evaluation
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes.checked_trajectories import check_trajectories
from torchrl_gn.training.budget import Budget
from torchrl_gn.training.gradients import with_gradients
from torchrl_gn.training.optimizers import (
    Preset,
    ScheduledOptimizer,
    make_optimizer,
    require_own_weights,
    trained_weights,
)
from torchrl_gn.training.trainer import Trainer

Optimizer = Preset | Callable[[Iterable[nn.Parameter]], torch.optim.Optimizer]

_NORMALIZER_SAMPLES = 5000
_HORIZON = 20  # steps of the rollouts of a validation
_LEAST_MOTION = 1e-6  # metres etc.: smaller changes may be jitter of bodies at rest


@dataclass(repr=False)
class History:
    """History of a training: the loss at up to 100 points, and the validation errors."""

    steps: list[int] = field(default_factory=list)  # number of each recorded step
    seconds: list[float] = field(default_factory=list)  # training time at each recorded step
    losses: list[float] = field(default_factory=list)  # mean loss since the last recorded step
    validations: list[tuple[int, float]] = field(default_factory=list)  # step, and 20-step error on the validation set

    def __str__(self) -> str:
        if not self.steps:
            return "no step"
        losses = f"loss {self.losses[0]:.2e} to {self.losses[-1]:.2e}"
        text = f"{self.steps[-1]:,} steps in {self.seconds[-1]:.0f} s, {losses}"
        best = min((error for _, error in self.validations), default=None)
        return text if best is None else f"{text}, best validation error {best:.2e}"

    def __repr__(self) -> str:
        return f"History({self})"  # hundreds of numbers hide everything else in a notebook


@with_gradients
def fit(
    model: BoundPredictor,
    trajectories: TensorDictBase,
    *,
    minutes: float | None = None,
    steps: int | None = None,
    validation: TensorDictBase | None = None,
    optimizer: Optimizer = "muon",
    lr: float | None = None,
    batch_size: int = 200,
    noise: float = 0.0,
    size_floor: float | None = 0.2,
    seed: int = 0,
    progress: bool = True,
) -> History:
    """Train a forward model on the trajectories of its scene.

    Fits the normalisers if they have seen no data, then minimises the one-step
    :class:`~torchrl_gn.objectives.ForwardModelLoss`. Later calls keep the normalisers, so the first call's data should
    resemble all later data. For windows, several scenes, checkpoints and several processes combine :class:`Trainer` and
    the losses yourself, as ``recipes/forward_model.py`` does.

    Args:
        model: forward model bound to the scene, ``ForwardModel.for_scene(scene).bind(scene)``; trained in place.
        trajectories: ``[M]`` of ``state`` ``[M, T + 1, N, 13]`` and ``action`` ``[M, T, A]``, see
            :func:`~torchrl_gn.data.collect_trajectories`.
        minutes: training time; default: one, if ``steps`` is not given.
        steps: number of optimiser steps.
        validation: ``[M]`` trajectories of at least 20 steps; the weights with the lowest 20-step error on them are
            kept.
        optimizer: a preset (:func:`make_optimizer`), or a function from parameters to an optimiser of ``torch.optim``,
            for example ``lambda weights: torch.optim.AdamW(weights, lr=1e-3)``.
        lr: peak learning rate, instead of the preset's.
        batch_size: transitions of an optimiser step.
        noise: standard deviation of the input noise, in standard deviations of each component.
        size_floor: lowers the weight of wild samples, see :class:`~torchrl_gn.objectives.ForwardModelLoss`; None
            (paper): equal weights.
        seed: seed of batches and noise. The model's initial weights come from torch's global generator.
        progress: show a progress bar.

    Raises:
        FloatingPointError: if the loss or the gradient is not finite; no weight changes at that step.
        TypeError: if the model is not bound, or is specialised and passes no gradient to the weights, or if
            ``optimizer`` is an optimiser instead of a function that makes one.
        ValueError: if ``lr`` is given with an optimiser that is not a preset, or an argument does not fit; if
            trajectories have numbers that are not finite, episodes that end inside, or, by the times in their
            ``physics``, another control step; if a component changes that never did in the model's first data.
    """
    budget = Budget(steps=steps, minutes=1.0 if minutes is None and steps is None else minutes)
    generator = torch.Generator().manual_seed(checked_seed(seed))
    loss = ForwardModelLoss(model, noise=noise, size_floor=size_floor, generator=generator)
    scheduled = _make_optimizer(model.model, optimizer, lr)
    buffer = trajectory_buffer(trajectories, batch_size=batch_size, seed=seed)
    check_trajectories(trajectories, model.scene, layout=model.layout)
    if validation is not None:
        check_trajectories(validation, model.scene, layout=model.layout)
        check_evaluation(validation, (_HORIZON,), model.scene, model.layout, of="validation=")
    require_own_weights("optimizer", scheduled.parameters, model.model)
    transitions = trajectory_buffer(trajectories, batch_size=_NORMALIZER_SAMPLES, seed=seed).sample()
    known = model.model.fitted
    (loss.fit_scales if known else loss.fit_normalizers)(transitions.to(model.movable.device))
    if known:
        _require_known_motion(model, loss)

    def validate() -> float:
        assert validation is not None
        table = evaluate_errors(model, validation, horizons=(_HORIZON,), one_step=False)
        return table.errors[f"rollout_error_{_HORIZON}"].total

    trainer = Trainer(loss, buffer, scheduled, budget, validate=None if validation is None else validate)
    history, recent = History(), []
    with tqdm(total=100, desc=f"training on {model.scene.name}", unit="%", disable=not progress, leave=False) as bar:
        for now in trainer.run():
            recent.append(now.loss)
            if now.validation is not None:
                history.validations.append((now.step, now.validation))
            # 100 points, for any budget.
            if now.fraction >= 1 or now.fraction * 100 >= len(history.steps) + 1:
                history.steps.append(now.step)
                history.seconds.append(now.seconds)
                history.losses.append(sum(recent) / len(recent))
                recent.clear()
                bar.set_postfix(step=now.step, loss=f"{history.losses[-1]:.1e}", refresh=False)
                bar.update(round(min(100 * now.fraction, 100)) - bar.n)
    trainer.restore_best()
    return history


def fit_ensemble(
    ensemble: BoundEnsemble,
    trajectories: TensorDictBase,
    *,
    minutes: float | None = None,
    steps: int | None = None,
    seed: int = 0,
    **options,
) -> list[History]:
    """Train the members of an ensemble on the same trajectories, each on its own batches.

    This drops an earlier calibration, which was fitted to other weights: calibrate again.

    Args:
        ensemble: bound to the scene, ``Ensemble.for_scene(scene).bind(scene)``; trained in place.
        trajectories: see :func:`fit`.
        minutes: training time of all members together; default: one minute per member, if ``steps`` is not given.
        steps: number of optimiser steps of each member.
        seed: seed of the first member; the others count up from it.
        **options: further options of :func:`fit`.

    Raises:
        TypeError: if the ensemble is not bound, or is specialised. Other errors are those of :func:`fit`.
    """
    members = [each for each in getattr(ensemble, "members", []) if isinstance(each, BoundPredictor)]
    if not isinstance(ensemble, BoundEnsemble) or len(members) < len(ensemble.members):
        raise TypeError("fit_ensemble() takes a bound ensemble: Ensemble.for_scene(scene).bind(scene).")
    member_minutes = None if minutes is None else minutes / len(members)
    histories = [
        fit(member, trajectories, minutes=member_minutes, steps=steps, seed=seed + index, **options)
        for index, member in enumerate(members)
    ]
    ensemble.calibration.clear()
    return histories


def _require_known_motion(model: BoundPredictor, loss: ForwardModelLoss) -> None:
    """Raise ValueError if a component changes in the data, but never did in the normalisers' data."""
    constant, weight = model.model.delta_normalizer.constant, loss.error_weight
    changes = (weight > 0) & (weight < 1 / _LEAST_MOTION)
    for component in model.layout.components:
        where = model.layout.delta_slices[component.name]
        if component.kind != "scalar" and bool(constant[where].all()) and bool(changes[where].any()):
            raise ValueError(
                f"{component.name!r} never changed in the model's first training data, so the model predicts no change"
                " of it: train a new model, from the start on data in which it changes."
            )


def _make_optimizer(module: nn.Module, optimizer: Optimizer, lr: float | None) -> ScheduledOptimizer:
    if isinstance(optimizer, torch.optim.Optimizer):
        kind = type(optimizer).__name__
        raise TypeError(
            f"optimizer takes a preset or a function: lambda weights: torch.optim.{kind}(weights, lr=1e-3)."
        )
    if not callable(optimizer):
        return make_optimizer(module, optimizer, lr=lr)
    if lr is not None:
        raise ValueError(f"lr={lr} is for presets; give {optimizer} its learning rate yourself.")
    trained_weights(module)
    return ScheduledOptimizer.of(optimizer(module.parameters()))
