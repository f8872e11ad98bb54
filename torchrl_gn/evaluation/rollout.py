"""Feed a model its own predictions, step after step."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_gn.dynamics import as_predictor
from torchrl_gn.finite import require_finite


def rollout(
    model: TensorDictModuleBase, state: Tensor, actions: Tensor, parameters: TensorDictBase | None = None
) -> Tensor:
    """States ``[*B, T + 1, N, 13]`` that a model predicts from a start state, which comes first.

    Differentiable in the state, the actions and the model's weights. Inputs are checked, predictions are not: see
    :func:`guarded_rollout`.

    Args:
        model: reads state and action at its first two ``in_keys`` and writes the next state at its first ``out_keys``.
        state: ``[*B, N, 13]`` start states.
        actions: ``[*B, T, A]`` controls; ``actions[..., t, :]`` leads from state ``t`` to ``t + 1``.
        parameters: physical parameters of each rollout ``[*B]``, or without batch. Default: the scene's.
    """
    _check(state, actions, parameters)
    return as_predictor(model).rollout(state, actions, parameters)[0]  # pyright: ignore[reportArgumentType]


class GuardedRollout(NamedTuple):
    """Rollouts of which some may have diverged."""

    states: Tensor  # [*B, T + 1, N, 13]; a diverged one keeps its last good state
    good_steps: Tensor  # [*B] number of good predictions; T if none was bad

    @property
    def diverged(self) -> Tensor:
        """``[*B]`` bool."""
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
    """A :func:`rollout` that stops what diverges. Not differentiable.

    A prediction is bad if it is not finite or, of a :class:`~torchrl_gn.dynamics.Predictor`, outside ``limit`` times
    the range of its training (:meth:`~torchrl_gn.dynamics.Predictor.in_range`).

    Args:
        model: like ``parameters`` as of :func:`rollout`.
        state: ``[*B, N, 13]`` start states; they are not judged.
        actions: ``[*B, T, A]``.
        hidden_state: ``[*B]`` hidden state of a recurrent model before the start.
        every: steps between two checks (each waits for a GPU). The batch is then narrowed to what goes on; a compiled
            model keeps its batch and stops when all have diverged. Other modules are checked after every step.
    """
    _check(state, actions, parameters)
    if not (limit > 0 and every >= 1):
        raise ValueError(f"limit must be positive and every at least 1, got limit={limit} and every={every}.")
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
        predicted = predicted[:, 1:]
        current, count = predicted[:, -1], predicted.shape[1]
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
    if bool((good < steps).any()):
        time = torch.arange(steps + 1, device=state.device)
        states = states[torch.arange(size, device=state.device)[:, None], torch.minimum(time, good[:, None])]
    return GuardedRollout(states.view(*batch, *states.shape[1:]), good.view(batch))


def _check(state: Tensor, actions: Tensor, parameters: TensorDictBase | None) -> None:
    if state.ndim < 2 or actions.ndim < 2 or state.shape[:-2] != actions.shape[:-2]:
        raise ValueError(
            f"rollout needs a state [*B, N, 13] and actions [*B, T, A] with the same *B,"
            f" got {list(state.shape)} and {list(actions.shape)}."
        )
    for what, given in (("state", state), ("actions", actions), ("parameters", parameters)):
        if given is not None:
            require_finite(given, what)
