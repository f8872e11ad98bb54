"""Rollouts, which feed a model its own predictions."""

from __future__ import annotations

from typing import NamedTuple, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_gn.checks import check_counts
from torchrl_gn.dynamics import AdaptedPredictor, BoundEnsemble, Predictor, as_predictor
from torchrl_gn.dynamics.ensemble import mean_of
from torchrl_gn.finite import require_finite
from torchrl_gn.networks.evaluation_mode import evaluation_mode


def rollout(
    model: TensorDictModuleBase, state: Tensor, actions: Tensor, parameters: TensorDictBase | None = None
) -> Tensor:
    """Predict states ``[*B, T + 1, N, 13]`` from a start state, which comes first; differentiable.

    For an ensemble, return the mean of its members' rollouts.

    Args:
        model: reads state and action at its first two ``in_keys`` and writes the next state at its first ``out_keys``.
        state: ``[*B, N, 13]``.
        actions: ``[*B, T, A]``.
        parameters: physical parameters of each rollout ``[*B]``, or without batch. Default: the scene's.
    """
    _check(state, actions, parameters)
    if isinstance(model, BoundEnsemble):
        return mean_of(model.rollout(state, actions), model.layout)
    return as_predictor(model).rollout(state, actions, parameters)[0]  # pyright: ignore[reportArgumentType]


@torch.no_grad()
def rollout_of(model: Predictor | BoundEnsemble | AdaptedPredictor, trajectories: TensorDictBase) -> Tensor:
    """Return rollouts ``[M, T + 1, N, C]`` from state 0 of trajectories ``[M]``, in evaluation mode, on the CPU.

    Trajectories may be on another device than the model. KeyError if they lack parameters that the model reads.
    """
    state, action = (cast(Tensor, trajectories.get(name)) for name in ("state", "action"))
    device = next(model.buffers()).device
    state, action = state.to(device), action.to(device)
    parameters = model.parameters_in(trajectories)
    parameters = None if parameters is None else parameters.to(device)
    with evaluation_mode(model):
        if isinstance(model, BoundEnsemble):
            return rollout(model, state[:, 0], action).cpu()
        if isinstance(model, AdaptedPredictor):
            return model.rollout(state[:, 0], action).cpu()
        return model.rollout(state[:, 0], action, parameters)[0].cpu()


class GuardedRollout(NamedTuple):
    """Rollouts, some of which may have diverged."""

    states: Tensor  # [*B, T + 1, N, 13]; a diverged one keeps its last good state
    good_steps: Tensor  # [*B] number of good predictions; T if all are good
    members: Tensor | None = None  # [K, *B, T + 1, N, 13] of an ensemble's members, NaN from where one diverged

    @property
    def diverged(self) -> Tensor:
        """``[*B]`` bool, True for rollouts that diverged."""
        return self.good_steps < self.states.shape[-3] - 1


@torch.no_grad()
def guarded_rollout(
    model: TensorDictModuleBase,
    state: Tensor,
    actions: Tensor,
    parameters: TensorDictBase | None = None,
    *,
    hidden_state: TensorDictBase | None = None,
    limit: float = 1000.0,
    every: int = 25,
) -> GuardedRollout:
    """Roll out a model and stop rollouts that diverge; not differentiable. See :func:`rollout`.

    A prediction is bad if it is not finite or, for a :class:`~torchrl_gn.dynamics.Predictor`, outside ``limit`` times
    its training range (:meth:`~torchrl_gn.dynamics.Predictor.in_range`). For an ensemble, return the mean of its
    members' rollouts, which is bad where any member's is.

    Args:
        hidden_state: ``[*B]`` hidden state of a recurrent model before the start.
        every: steps between two checks of a predictor (each waits for a GPU); other modules: 1.
    """
    _check(state, actions, parameters)
    check_counts(every=every)
    if not limit > 0:
        raise ValueError(f"limit={limit} must be positive.")
    if isinstance(model, BoundEnsemble):
        options = {"limit": limit, "every": every}
        each = [guarded_rollout(member, state, actions, parameters, **options) for member in model.members]
        members, lasted = (torch.stack(parts) for parts in zip(*(member[:2] for member in each), strict=True))
        over = torch.arange(members.shape[-3], device=members.device) > lasted.unsqueeze(-1)
        members, good = torch.where(over[..., None, None], torch.nan, members), lasted.amin(0)
        return GuardedRollout(_hold_after(mean_of(members, model.layout), good), good, members)
    predictor = as_predictor(model)
    every = getattr(predictor, "check_every", every)
    batch, steps = state.shape[:-2], actions.shape[-2]
    size = batch.numel()
    current, actions = state.reshape(size, *state.shape[-2:]), actions.reshape(size, *actions.shape[-2:])
    if parameters is not None and parameters.ndim:
        parameters = parameters.reshape(size)
    if hidden_state is not None:
        hidden_state = hidden_state.reshape(size)
    rows = torch.arange(size, device=state.device)
    good = torch.full_like(rows, steps)
    states = current.new_empty(size, steps + 1, *current.shape[1:])
    states[:, 0] = current
    for first in range(0, steps, every):
        now = actions[:, first : first + every]
        predicted, hidden_state = predictor.rollout(current, now, parameters, hidden_state)  # pyright: ignore[reportArgumentType]
        predicted, current, count = predicted[:, 1:], predicted[:, -1], now.shape[1]
        states[rows, first + 1 : first + 1 + count] = predicted
        fine = predictor.in_range(predicted, limit)
        if bool(fine.all()):
            continue
        lasted = fine.long().cumprod(1).sum(1)
        good[rows] = torch.minimum(good[rows], torch.where(lasted < count, first + lasted, steps))
        going = good[rows] == steps
        if not bool(going.any()):
            break
        if not predictor.fixed_batch:
            rows, current, actions = rows[going], current[going], actions[going]
            parameters = parameters[going] if parameters is not None and parameters.ndim else parameters
            hidden_state = None if hidden_state is None else hidden_state[going]
    return GuardedRollout(_hold_after(states, good).view(*batch, *states.shape[1:]), good.view(batch))


def _hold_after(states: Tensor, good: Tensor) -> Tensor:
    """Hold states ``[*B, T + 1, N, 13]`` constant after a number of good steps ``[*B]``."""
    time = torch.arange(states.shape[-3], device=states.device)
    at = torch.minimum(time, good.unsqueeze(-1))[..., None, None]
    return states.gather(-3, at.expand_as(states)) if bool((good < len(time) - 1).any()) else states


def _check(state: Tensor, actions: Tensor, parameters: TensorDictBase | None) -> None:
    if state.ndim < 2 or actions.ndim < 2 or state.shape[:-2] != actions.shape[:-2]:
        shapes = f"{list(state.shape)} and {list(actions.shape)}"
        raise ValueError(f"rollout needs a state [*B, N, 13] and actions [*B, T, A] of one *B, got {shapes}.")
    for name, tensor in (("state", state), ("actions", actions), ("parameters", parameters)):
        if tensor is not None:
            require_finite(tensor, name)
