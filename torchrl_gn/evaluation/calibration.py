"""Calibration of an ensemble's standard deviations, and their coverage of its errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_gn.checks import sorted_horizons
from torchrl_gn.dynamics.ensemble import BoundEnsemble, mean_and_spread, mean_squares
from torchrl_gn.dynamics.predictor import require_bound
from torchrl_gn.maths.state_layout import StateLayout
from torchrl_gn.networks.evaluation_mode import evaluation_mode
from torchrl_gn.scenes import Articulation, Scene
from torchrl_gn.scenes.checked_trajectories import check_trajectories, require_trajectories

COVERAGE_HORIZONS = (1, 10, 50, 100)  # steps after which coverage is measured by default
_AT_ONCE = 100  # trajectories to predict at once
_CANDIDATES = 21  # number of factors to try
_STATES = 5_000  # approximate number of states at which one-step errors are measured
_FLOORS = tuple(2.0**power for power in range(-2, 8))  # floors to try, in medians of the spread
_FREEDOM = 4.0  # degrees of freedom of the errors' Student's t distribution
_ONE, _TWO = 0.6827, 0.9545  # shares of a normal distribution within one and two standard deviations


@torch.no_grad()
def calibrate(ensemble: BoundEnsemble, trajectories: TensorDictBase) -> None:
    """Fit an ensemble's standard deviations, in place, to rollouts from the trajectories' first states.

    Every component and step has a factor and a floor (:class:`~torchrl_gn.dynamics.Calibration`). The factor brings the
    shares of errors within one and two standard deviations as close to a normal distribution's as one number can
    (Kuleshov et al. 2018 fit a curve instead). The floor maximises the likelihood: it accounts for errors where members
    agree by chance, and for the noise of a robot's log. Earlier specialised copies of the ensemble share both numbers.

    Args:
        ensemble: bound to the scene, or specialised.
        trajectories: ``[M]`` of ``state`` ``[M, T + 1, N, 13]`` and ``action`` ``[M, T, A]``: about 100 or more, on
            which no member was trained.

    Raises:
        TypeError: if the ensemble is not bound to a scene, or a single model.
        ValueError: if all rollouts diverge. If only some do, they are left out, as their standard deviation is infinite
            anyway. Also if trajectories are not finite, have another control step, see
            :func:`~torchrl_gn.training.fit`, or are of other variants than the ensemble's scene.
    """
    _require_ensemble(ensemble, "calibrate")
    check_trajectories(trajectories, ensemble.scene, layout=ensemble.layout)
    ensemble.parameters_in(trajectories)
    steps = trajectories["action"].shape[1]
    error, spread = _errors(ensemble, trajectories, range(1, steps + 1))
    layout, movable = ensemble.layout, ensemble.counted
    factor, floor = (torch.zeros(steps, len(layout.names), dtype=torch.float64) for _ in range(2))
    for index, where in enumerate(layout.delta_slices.values()):
        moves = movable[:, where]
        for step in range(steps) if moves.any() else ():
            wrong, between = (each[:, step, :, where][:, moves].flatten() for each in (error, spread))
            finite = between.isfinite()
            if not finite.any():
                raise ValueError(f"All rollouts diverge by step {step + 1}: train the members for longer.")
            factor[step, index], floor[step, index] = _factor_and_floor(wrong[finite], between[finite])
    ensemble.calibration.set(factor, floor, torch.zeros(len(layout.names)))
    names, fixed = layout.names, fixed_components(ensemble.scene, layout)
    typical = _one_step(ensemble, trajectories)[0].mean(0).sqrt()
    typical[[index for index, name in enumerate(names) if name in fixed]] = 0
    ensemble.calibration.set(factor, floor, typical)


@dataclass(frozen=True)
class Coverage:
    """Comparison of standard deviations with errors, by component and number of steps."""

    names: tuple[str, ...]  # components that can move
    horizons: tuple[int, ...]  # numbers of steps
    one: Tensor  # [H, C] share of errors within one standard deviation; ideally 0.68, as of a normal distribution
    two: Tensor  # [H, C] share of errors within two standard deviations; ideally 0.95
    sharpness: Tensor  # [H, C] root mean square of the standard deviation over that of the error; ideally 1
    rank: Tensor  # [H, C] rank correlation of standard deviation and absolute error over rollouts; ideally 1
    doubt: Tensor  # [] root mean square of BoundEnsemble.doubt over the trajectories' states; 1 on the calibration's
    doubt_rank: Tensor  # [] rank correlation of doubt and true error of the next step; ideally 1

    def to_metrics(self) -> dict[str, float]:
        """Return the numbers by ``<measure>_<steps>/<component>``, and ``doubt`` and ``doubt_rank``."""
        kinds = {"one": self.one, "two": self.two, "sharpness": self.sharpness, "rank": self.rank}
        return {
            f"{kind}_{steps}/{name}": values[row, column].item()
            for kind, values in kinds.items()
            for row, steps in enumerate(self.horizons)
            for column, name in enumerate(self.names)
        } | {"doubt": self.doubt.item(), "doubt_rank": self.doubt_rank.item()}

    def __str__(self) -> str:
        lines = [f"{'within 1 / 2 std':22}" + "".join(f"{f'after {steps}':>16}" for steps in self.horizons)]
        for column, name in enumerate(self.names):
            cells = [f"{self.one[row, column]:.2f} / {self.two[row, column]:.2f}" for row in range(len(self.horizons))]
            lines.append(f"{name:22}" + "".join(f"{cell:>16}" for cell in cells))
        doubt = (
            f"doubt {self.doubt:.2f} (1: as in the calibration's data), rank correlation with the true error of a step"
        )
        return "\n".join([*lines, f"{doubt} {self.doubt_rank:.2f}"])


@torch.no_grad()
def evaluate_coverage(
    ensemble: BoundEnsemble, trajectories: TensorDictBase, *, horizons: Sequence[int] = COVERAGE_HORIZONS
) -> Coverage:
    """Measure how many errors lie within the predicted standard deviations, in rollouts from the first states.

    Args:
        ensemble: a calibrated ensemble.
        trajectories: ``[M]``, used neither for training nor for calibration.
        horizons: numbers of steps, each up to the trajectories' length.

    Raises:
        RuntimeError: if the ensemble is not calibrated.
        TypeError: if the ensemble is not bound to a scene, or a single model.
        ValueError: if a horizon is not whole or longer than the trajectories, or trajectories are unfit as for
            :func:`calibrate`.
    """
    _require_ensemble(ensemble, "evaluate_coverage")
    require_trajectories(trajectories)
    ensemble.parameters_in(trajectories)
    layout, steps = ensemble.layout, trajectories["action"].shape[1]
    horizons = sorted_horizons(horizons)
    if not horizons or horizons[-1] > steps:
        raise ValueError(f"horizons={list(horizons)} must be from 1 to the trajectories' {steps} steps.")
    check_trajectories(trajectories, ensemble.scene, layout=layout)
    return coverage_of(ensemble, trajectories, horizons, *_errors(ensemble, trajectories, horizons))


def coverage_of(
    ensemble: BoundEnsemble, trajectories: TensorDictBase, horizons: tuple[int, ...], error: Tensor, spread: Tensor
) -> Coverage:
    """Return :func:`evaluate_coverage` of known :func:`deviations` after the ``horizons``."""
    layout, movable = ensemble.layout, ensemble.counted
    std = ensemble.calibration(spread, layout, horizons)
    fixed = fixed_components(ensemble.scene, layout)
    names = tuple(name for name in layout.names if name not in fixed)
    rows = torch.zeros(4, len(horizons), len(names), dtype=torch.float64)
    for column, name in enumerate(names):
        where = layout.delta_slices[name]
        moves = movable[:, where]
        wrong, stated = (each[..., where][..., moves] for each in (error, std))  # [M, H, channels]
        # A diverged rollout's infinite standard deviation counts as covering no error.
        known = stated.isfinite()
        rows[0, :, column] = (known & (wrong <= stated)).double().mean((0, 2))
        rows[1, :, column] = (known & (wrong <= 2 * stated)).double().mean((0, 2))
        sizes = [each.square().mean((0, 2)).sqrt() for each in (stated, wrong)]
        rows[2, :, column] = sizes[0] / sizes[1]
        whole = [each.square().mean(-1) for each in (stated, wrong)]  # [M, H]
        rows[3, :, column] = torch.stack(
            [_rank_correlation(*(each[:, row] for each in whole)) for row in range(len(horizons))]
        )
    doubt, true = map(ensemble.calibration.by_typical, _one_step(ensemble, trajectories))
    one, two, sharpness, rank = rows
    usual, doubt_rank = doubt.square().mean().sqrt(), _rank_correlation(doubt, true)
    return Coverage(names, horizons, one, two, sharpness, rank, usual, doubt_rank)


def _require_ensemble(ensemble: object, what: str) -> None:
    """Raise TypeError unless an ensemble is bound to a scene."""
    require_bound(ensemble)
    if not isinstance(ensemble, BoundEnsemble):
        raise TypeError(
            f"{what} takes an ensemble, Ensemble.for_scene(scene).bind(scene), not {type(ensemble).__name__}."
        )


def fixed_components(scene: Articulation, layout: StateLayout) -> set[str]:
    """Return the components that errors leave out: those that cannot move, and those with known dynamics."""
    movable = scene.movable[scene.predicted]
    fixed = {name for name, where in layout.delta_slices.items() if not movable[:, where].any()}
    if not isinstance(scene, Scene):
        return fixed
    return fixed | {"past_control", "unwrapped_angle"} | ({"activation"} if scene.activations.known.all() else set())


def deviations(ensemble: BoundEnsemble, members: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean's absolute error and the spread ``[*B, N, 12]`` of members' states ``[K, *B, N, 13]``."""
    mean, spread = mean_and_spread(members, ensemble.layout)
    return ensemble.layout.delta(mean, truth).abs().double(), spread.double()


def _errors(ensemble: BoundEnsemble, trajectories: TensorDictBase, horizons: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Return the :func:`deviations` ``[M, H, N, 12]`` of rollouts from the trajectories' first states."""
    device, rows, chunks = ensemble.counted.device, list(horizons), []
    for first in range(0, len(trajectories), _AT_ONCE):
        state, action = (
            cast(Tensor, trajectories[name])[first : first + _AT_ONCE].to(device) for name in ("state", "action")
        )
        with evaluation_mode(ensemble):
            predicted = ensemble.rollout(state[:, 0], action[:, : max(rows)])
        chunks.append(deviations(ensemble, predicted[..., rows, :, :], state[:, rows]))
    error, spread = map(torch.cat, zip(*chunks, strict=True))
    return error, spread


def _one_step(ensemble: BoundEnsemble, trajectories: TensorDictBase) -> tuple[Tensor, Tensor]:
    """Return mean squares ``[S, C]`` of a step's standard deviations and errors, at states spread over trajectories."""
    state, action = (cast(Tensor, trajectories[key]) for key in ("state", "action"))
    before, after, actions = state[:, :-1].flatten(0, 1), state[:, 1:].flatten(0, 1), action.flatten(0, 1)
    stride = max(1, len(before) // _STATES)
    while math.gcd(stride, action.shape[1]) > 1:  # else it would take the same times of all trajectories
        stride += 1
    some = slice(None, None, stride)
    before, after, actions = (tensor[some].to(ensemble.counted.device) for tensor in (before, after, actions))
    with evaluation_mode(ensemble):
        mean, spread = mean_and_spread(ensemble.step(before, actions), ensemble.layout)
    std = ensemble.calibration(spread.unsqueeze(-3), ensemble.layout).squeeze(-3)
    error = ensemble.layout.delta(mean, after)
    known = std.isfinite().flatten(1).all(1)
    stated, wrong = (mean_squares(tensor[known].double(), ensemble.counted, ensemble.layout) for tensor in (std, error))
    return stated, wrong


def _factor_and_floor(wrong: Tensor, spread: Tensor) -> Tensor:
    """Return the factor and floor ``[2]`` of greatest likelihood among the floors to try."""
    fits, losses = [], []
    for floor in spread.median() * spread.new_tensor(_FLOORS):
        size = (spread.square() + floor.square()).sqrt()
        factor = _factor(torch.where(size > 0, wrong / size, 0.0))
        std = torch.where(size > 0, factor * size, 1.0).clamp(min=torch.finfo(size.dtype).tiny)
        # Student's t keeps a few large errors from dominating.
        tails = (_FREEDOM + 1) / 2 * ((wrong / std).square() / _FREEDOM).log1p()
        losses.append((std.log() + tails).mean())
        fits.append(torch.stack((factor, floor)))
    return fits[int(torch.stack(losses).argmin())]


def _factor(ratios: Tensor) -> Tensor:
    """Return the factor for which the shares of ratios within one and two factors come nearest to the normal ones."""
    one, two = (ratios.kthvalue(max(1, round(share * len(ratios)))).values for share in (_ONE, _TWO))
    # Each end of the candidates matches one share; the tails decide between them.
    candidates = torch.lerp(one, two / 2, torch.linspace(0, 1, _CANDIDATES, dtype=ratios.dtype)).unsqueeze(-1)
    off = [((ratios <= many * candidates).double().mean(-1) - share).abs() for many, share in ((1, _ONE), (2, _TWO))]
    return candidates[torch.maximum(*off).argmin()].squeeze(-1)


def _rank_correlation(a: Tensor, b: Tensor) -> Tensor:
    """Return Spearman's rank correlation of two vectors; 0 if one is constant. Equal values share their mean rank."""
    ranks = []
    for each in (a, b):
        _, group, size = torch.unique(each, return_inverse=True, return_counts=True)
        ranks.append((size.cumsum(0) - (size - 1) / 2)[group].double())
    return torch.corrcoef(torch.stack(ranks))[0, 1].nan_to_num(0.0)
