"""One-step and rollout errors relative to the persistence baseline (paper, "Prediction performance evaluation")."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import cast

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_gn.checks import check_count, sorted_horizons
from torchrl_gn.dynamics import BoundEnsemble, as_predictor
from torchrl_gn.dynamics.predictor import require_bound
from torchrl_gn.evaluation.calibration import coverage_of, deviations, fixed_components
from torchrl_gn.evaluation.error_table import ErrorTable, PredictionError
from torchrl_gn.evaluation.rollout import GuardedRollout, guarded_rollout
from torchrl_gn.finite import require_finite
from torchrl_gn.maths import quaternion
from torchrl_gn.maths.state_layout import BODY_STATE, StateLayout
from torchrl_gn.networks.evaluation_mode import evaluation_mode
from torchrl_gn.scenes import Articulation
from torchrl_gn.scenes.checked_trajectories import (
    check_control_step,
    check_episodes,
    check_numbers,
    require_trajectories,
)

HORIZONS = (20, 100)  # default lengths of rollouts, steps
_ROUNDING = 1e-24  # mean squared changes below this are rounding errors of metres, not motion


def squared_errors(prediction: Tensor, truth: Tensor, layout: StateLayout = BODY_STATE) -> Tensor:
    """Return the squared error ``[..., C]`` of every component of states ``[..., 13]``: m^2, rad^2, (m/s)^2, (rad/s)^2.

    The result is float64. Quaternions need not have unit norm, and ``q`` equals ``-q``.
    """
    prediction, truth = prediction.double(), truth.double()
    errors = []
    for component in layout.components:
        where = layout.slices[component.name]
        a, b = prediction[..., where], truth[..., where]
        if component.adds:
            errors.append((a - b).square().sum(-1))
        elif component.kind == "rotation":
            errors.append(quaternion.angle(a, b).square())
        else:
            cross = b[..., 0] * a[..., 1] - b[..., 1] * a[..., 0]
            errors.append(torch.atan2(cross, (a * b).sum(-1)).square())
    return torch.stack(errors, dim=-1)


def evaluate_errors(
    model: TensorDictModuleBase,
    trajectories: TensorDictBase,
    *,
    horizons: Sequence[int] = HORIZONS,
    one_step: bool = True,
    burn_in: int = 0,
    batch_size: int = 1000,
    keep: int = 0,
    scene: Articulation | None = None,
    device: torch.device | str | None = None,
) -> ErrorTable:
    """Evaluate a model on test trajectories, in batches, in evaluation mode, without gradients.

    ``one_step_error`` covers every step, ``rollout_error_<H>`` steps 1 to ``H`` of rollouts from state 0. Both are
    relative to the persistence baseline with the same start states. The error of a component is a ratio of means over
    predicted nodes, steps and sequences; a component that never moves is left out. The total is the mean over
    components, infinite if a prediction diverges. For an ensemble, these are errors of the mean; if it is calibrated,
    the table also has the coverage of its standard deviations at step 1 and the horizons; rollouts that diverge are
    outside.

    Args:
        model: reads state and action at its first two ``in_keys``, writes the next state at its first ``out_keys``.
        trajectories: ``[M]`` with ``"state"`` ``[M, T + 1, N, 13]``, ``"action"`` ``[M, T, A]`` and, if the model reads
            them, physical parameters ``[M]`` at its ``parameters_key``.
        burn_in: steps at the start of every trajectory that only prepare a recurrent model's hidden state.
        keep: number of predicted rollouts to return in the table.
        scene: says which nodes count and which components are movable. Default: ``model.scene``.

    Raises:
        TypeError: if the model is not bound to a scene, or the trajectories are no TensorDict.
        ValueError: if a horizon or another count is not whole or too small, trajectories are shorter than ``burn_in``
            and the longest horizon, not finite, or of another control step or shape, or nothing moves in them.
    """
    require_bound(model)
    require_trajectories(trajectories)
    scene = scene or cast(Articulation, model.scene)
    layout: StateLayout = getattr(model, "layout", BODY_STATE)
    horizons = sorted_horizons(horizons)
    if not (horizons or one_step):
        raise ValueError("No error is asked for: give horizons=, or one_step=True.")
    for option, count, least in (("burn_in", burn_in, 0), ("batch_size", batch_size, 1), ("keep", keep, 0)):
        check_count(option, count, least)
    states, actions = trajectories.get("state"), trajectories.get("action")
    check_evaluation(trajectories, [burn_in + horizon for horizon in horizons], scene, layout)
    if burn_in >= actions.shape[1]:
        raise ValueError(f"burn_in={burn_in} must be less than the trajectories' {actions.shape[1]} steps.")
    check_episodes(trajectories)
    check_control_step(trajectories, scene)
    steps, horizon = actions.shape[1] - burn_in, max(horizons, default=0)
    device = device or next(itertools.chain(model.parameters(), model.buffers()), states).device
    predicted = torch.as_tensor(np.flatnonzero(scene.predicted), device=device)
    single, rollouts = ErrorSums(1, layout, predicted), ErrorSums(horizon, layout, predicted)
    predictor = as_predictor(model)
    if (parameters := predictor.parameters_in(trajectories)) is not None:
        require_finite(parameters, "parameters of the trajectories")
    first_rollouts: list[Tensor] = []
    calibrated = model if isinstance(model, BoundEnsemble) and model.calibration.fitted and horizons else None
    steps_with_std, batches = sorted({1, *horizons}), []

    with torch.no_grad(), evaluation_mode(model):
        size = max(1, batch_size // steps)
        for state, action, values in _batches(states, actions, parameters, size, device, layout) if one_step else ():
            prediction = predictor.teacher_forced(state[:, :-1], action, values)[0][:, burn_in:].flatten(0, 1)
            flat, truth = state[:, burn_in:-1].flatten(0, 1), state[:, burn_in + 1 :].flatten(0, 1)
            valid = single.add(0, prediction, truth, flat)
            single.diverged[0] += (~valid.reshape(len(state), steps).all(-1)).sum()
        for state, action, values in (
            _batches(states, actions, parameters, batch_size, device, layout) if horizons else ()
        ):
            missing, hidden_state = max(0, min(keep - sum(map(len, first_rollouts)), len(state))), None
            if burn_in and predictor.recurrent:  # others have nothing to warm up
                _, hidden_state = predictor.teacher_forced(state[:, :burn_in], action[:, :burn_in], values)
            state, action = state[:, burn_in:], action[:, burn_in:]
            guarded = guarded_rollout(model, state[:, 0], action[:, :horizon], values, hidden_state=hidden_state)
            first_rollouts.append(_add_rollouts(guarded, state, rollouts, missing))
            if calibrated is not None:
                members = cast(Tensor, guarded.members)[..., steps_with_std, :, :]
                batches.append(deviations(calibrated, members, state[:, steps_with_std]))

    fixed = fixed_components(scene, layout)
    errors = [single.error("one_step_error", 1, len(states), steps, fixed)] if one_step else []
    errors += [rollouts.error(f"rollout_error_{h}", h, len(states), h, fixed) for h in horizons]
    table = {error.name: error for error in errors}
    coverage = None
    if calibrated is not None:
        from_start = TensorDict({"state": states[:, burn_in:], "action": actions[:, burn_in:]}, [len(states)])
        error, spread = map(torch.cat, zip(*batches, strict=True))
        with torch.no_grad():
            coverage = coverage_of(calibrated, from_start, tuple(steps_with_std), error, spread)
    return ErrorTable(
        table, torch.cat(first_rollouts) if first_rollouts else states.new_zeros((0, 1, *states.shape[2:])), coverage
    )


class ErrorSums:
    """Sums of squared errors of the model and of the persistence baseline, per step."""

    def __init__(self, steps: int, layout: StateLayout, predicted: Tensor) -> None:
        self.layout, self.predicted = layout, predicted
        self.model = torch.zeros(steps, len(layout.names), dtype=torch.float64, device=predicted.device)
        self.persistence = torch.zeros_like(self.model)
        self.diverged = torch.zeros(steps, dtype=torch.long, device=predicted.device)  # sequences diverged by each step

    def add(self, step: int, prediction: Tensor, truth: Tensor, initial: Tensor, alive: Tensor | None = None) -> Tensor:
        """Add errors of states ``[B, N, 13]``; return bool ``[B]``, True if the prediction is still a valid state."""
        truth = truth[:, self.predicted]
        squared = self._squared(prediction, truth)
        valid = squared.isfinite().all(-1) & (True if alive is None else alive)
        self.model[step] += torch.where(valid[:, None], squared, torch.inf).sum(0)
        self.persistence[step] += self._squared(initial, truth).sum(0)
        return valid

    def _squared(self, prediction: Tensor, truth: Tensor) -> Tensor:
        prediction = prediction[:, self.predicted]
        squared = squared_errors(prediction, truth, self.layout).mean(1)
        # A zero quaternion has no angle, but atan2(0, 0) would call it perfect.
        no_state = self.layout.without_angle(prediction).any(-1, keepdim=True)
        return torch.where(no_state, torch.inf, squared)

    def error(self, name: str, steps: int, sequences: int, count: int, fixed: set[str]) -> PredictionError:
        """Return the error over the first ``steps`` rows, which sum ``sequences * count`` terms in all."""
        means = ((sums[:steps].sum(0) / (sequences * count)).tolist() for sums in (self.model, self.persistence))
        squared, baselines = (dict(zip(self.layout.names, values, strict=True)) for values in means)
        left_out = tuple(n for n, value in baselines.items() if n in fixed or value <= _ROUNDING)
        components = {n: value / baselines[n] for n, value in squared.items() if n not in left_out}
        if not components:
            raise ValueError(f"Nothing moves in the trajectories, so {name} relative to no change has no meaning.")
        return PredictionError(name, components, squared, baselines, left_out, sequences, int(self.diverged[steps - 1]))


def _add_rollouts(guarded: GuardedRollout, truth: Tensor, sums: ErrorSums, keep: int) -> Tensor:
    """Add the errors of rollouts to ``sums``; return the first ``keep`` rollouts, NaN from where they diverged."""
    alive, states = guarded.good_steps >= 0, [truth[:keep, 0]]
    for step in range(1, guarded.states.shape[1]):
        current = guarded.states[:, step]
        alive = sums.add(step - 1, current, truth[:, step], truth[:, 0], alive & (guarded.good_steps >= step))
        sums.diverged[step - 1] += (~alive).sum()
        states.append(torch.where(alive[:keep, None, None], current[:keep], torch.nan))
    return torch.stack(states, dim=1).cpu()


def _batches(
    states: Tensor,
    actions: Tensor,
    parameters: TensorDictBase | None,
    size: int,
    device: torch.device | str,
    layout: StateLayout,
) -> Iterator[tuple[Tensor, Tensor, TensorDictBase | None]]:
    for start in range(0, len(states), size):
        rows = slice(start, start + size)
        state = torch.as_tensor(states[rows]).to(device)
        action = torch.as_tensor(actions[rows]).to(state.device)
        batch_parameters = None if parameters is None else parameters[rows].to(state.device)
        check_numbers(state, action, layout, first=start)
        yield state, action, batch_parameters


def check_evaluation(
    trajectories: TensorDictBase,
    horizons: Sequence[int],
    scene: Articulation,
    layout: StateLayout,
    *,
    of: str | None = None,
) -> None:
    """Raise ValueError unless trajectories ``[M]`` have states and actions of a scene, and rollouts of all horizons.

    ``of`` names the option that they were given by, if a caller cannot choose the horizons.
    """
    states, actions = trajectories.get("state", None), trajectories.get("action", None)
    if states is None or actions is None:
        raise ValueError('Trajectories need the entries "state" [M, T + 1, N, 13] and "action" [M, T, A].')
    if states.ndim != 4 or states.shape[2:] != (scene.num_nodes, layout.size):
        expected_shape = f"[M, T + 1, {scene.num_nodes}, {layout.size}]"
        raise ValueError(f"States of scene {scene.name!r} must be {expected_shape}, got {list(states.shape)}.")
    if states.shape[0] == 0 or states.shape[1] < 2:
        raise ValueError(f"Errors need at least one sequence of two states, got {list(states.shape)}.")
    expected = (states.shape[0], states.shape[1] - 1, scene.num_actions)
    if actions.shape != expected:
        raise ValueError(f"Actions must be {list(expected)} like the states, got {list(actions.shape)}.")
    if horizons and max(horizons) > expected[1]:
        where, remedy = ("", "give shorter horizons=, or") if of is None else (f" in {of}", "give")
        raise ValueError(
            f"A rollout of {max(horizons)} steps needs trajectories as long{where}, got {expected[1]} steps: {remedy}"
            " longer trajectories."
        )
