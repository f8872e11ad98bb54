"""Feed a model its own predictions, step after step."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_gn.dynamics import Predictor
from torchrl_gn.finite import require_finite


def predict(
    model: TensorDictModuleBase, state: Tensor, action: Tensor, parameters: TensorDictBase | None = None
) -> Tensor:
    """Predict one step with a bound model, whatever its keys.

    Args:
        model: reads ``(state, action)`` at its first two ``in_keys`` and writes the
            next state at its first ``out_keys``.
        state: ``[*B, N, 13]``.
        action: ``[*B, A]``.
        parameters: physical parameters ``[*B]`` of every sample, for a :class:`~torchrl_gn.dynamics.Predictor`.

    Returns:
        ``[*B, N, 13]`` next states.
    """
    if isinstance(model, Predictor):
        return model.step(state, action, parameters)
    state_key, action_key = model.in_keys[:2]
    # A key may be nested; set() splits it.
    tensordict = TensorDict(batch_size=state.shape[:-2])
    tensordict.set(state_key, state)
    tensordict.set(action_key, action)
    return model(tensordict).get(model.out_keys[0])


def rollout(
    model: TensorDictModuleBase, state: Tensor, actions: Tensor, parameters: TensorDictBase | None = None
) -> Tensor:
    """States that a model predicts from a start state under a sequence of actions.

    Differentiable in the state, the actions and the model's weights, through
    every step; open :func:`torch.no_grad` around it where no gradient is wanted. What goes in is
    checked, what is predicted is not: see :func:`guarded_rollout`.

    Args:
        model: bound forward model (``in_keys`` state and action, ``out_keys`` next state).
        state: ``[*B, N, 13]`` start states.
        actions: ``[*B, T, A]`` controls; ``actions[..., t, :]`` leads from state ``t`` to ``t + 1``.
        parameters: physical parameters of every rollout ``[*B]``, or without batch; by default the scene's.

    Returns:
        ``[*B, T + 1, N, 13]``; the first is the start state itself.

    Raises:
        ValueError: if the batch shapes of ``state`` and ``actions`` differ, or a number is not finite.
    """
    _check(state, actions, parameters)
    return _unchecked(model, state, actions, parameters)


def _unchecked(
    model: TensorDictModuleBase, state: Tensor, actions: Tensor, parameters: TensorDictBase | None
) -> Tensor:
    if isinstance(model, Predictor):
        return model.rollout(state, actions, parameters)
    states = [state]
    for action in actions.unbind(-2):
        states.append(predict(model, states[-1], action))
    return torch.stack(states, dim=-3)


class GuardedRollout(NamedTuple):
    """Rollouts of which some may have diverged.

    Attributes:
        states: ``[*B, T + 1, N, 13]``; one that diverged keeps its last good state from then on.
        good_steps: ``[*B]`` integers, how many predictions were good; ``T`` where none was bad.
    """

    states: Tensor
    good_steps: Tensor

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
    """A :func:`rollout` that notices what diverges, and spends no more time on it.

    A prediction is bad where it is not finite, or where a body is farther from its scene's centre
    (from the origin along axes that are not translation invariant) or faster than ``limit`` times
    the root mean square in the model's training: lengths of vectors, so it does not matter how
    the scene is turned. Modules that are not a :class:`~torchrl_gn.dynamics.Predictor` have
    no such range and are checked for finite numbers alone.

    The others' states are those of :func:`rollout`, to rounding where the batch was narrowed. Nothing is
    differentiated.

    Args:
        model: as for :func:`rollout`.
        state: ``[*B, N, 13]`` start states; they themselves are not judged.
        actions: ``[*B, T, A]``.
        parameters: as for :func:`rollout`.
        hidden_state: ``[*B]``, what a :class:`~torchrl_gn.dynamics.RecurrentPredictor` remembers of before the start.
        limit: how far out of the range of the training a state may be.
        every: steps between two looks (each waits for a GPU). The batch is then narrowed to what goes on; a
            compiled model keeps its batch, for which it was compiled, and stops when all have
            diverged. Modules that are not a Predictor are looked at after every step.

    Returns:
        The states, and how many predictions of each rollout were good.

    Raises:
        ValueError: if the batch shapes of ``state`` and ``actions`` differ, a number is not finite, or ``limit`` or
            ``every`` is not positive.
    """
    _check(state, actions, parameters)
    if not (limit > 0 and every >= 1):
        raise ValueError(f"limit must be positive and every at least 1, got limit={limit} and every={every}.")
    if not isinstance(model, Predictor):
        every = 1
    batch, steps = state.shape[:-2], actions.shape[-2]
    size = batch.numel()
    current, actions = state.reshape(size, *state.shape[-2:]), actions.reshape(size, *actions.shape[-2:])
    if parameters is not None and parameters.ndim:
        parameters = parameters.reshape(size)
    if hidden_state is not None:
        hidden_state = hidden_state.reshape(size)
    ranges = _ranges(model, limit)
    rows = torch.arange(size, device=state.device)
    good = torch.full_like(rows, steps)
    states = current.new_empty(size, steps + 1, *current.shape[1:])
    states[:, 0] = current
    for first in range(0, steps, every):
        now = actions[:, first : first + every]
        if isinstance(model, Predictor):
            predicted, hidden_state = model.rollout_and_hidden_state(current, now, parameters, hidden_state)
        else:
            predicted = _unchecked(model, current, now, parameters)
        predicted = predicted[:, 1:]
        current, count = predicted[:, -1], predicted.shape[1]
        states[rows, first + 1 : first + 1 + count] = predicted
        fine = _good(model, predicted, ranges)
        if bool(fine.all()):
            continue
        lasted = fine.long().cumprod(1).sum(1)
        good[rows] = torch.minimum(good[rows], torch.where(lasted < count, first + lasted, steps))
        going = good[rows] == steps
        if not bool(going.any()):
            break
        if not getattr(model, "compile_steps", False):
            rows, current, actions = rows[going], current[going], actions[going]
            parameters = parameters[going] if parameters is not None and parameters.ndim else parameters
            hidden_state = None if hidden_state is None else hidden_state[going]
    if bool((good < steps).any()):
        time = torch.arange(steps + 1, device=state.device)
        states = states[torch.arange(size, device=state.device)[:, None], torch.minimum(time, good[:, None])]
    return GuardedRollout(states.view(*batch, *states.shape[1:]), good.view(batch))


def _ranges(model: TensorDictModuleBase, limit: float) -> list[tuple[slice, Tensor]]:
    """Channels of each vector in a state, and how long its square may be."""
    if not isinstance(model, Predictor):
        return []
    normalizer, layout = model.model.node_normalizer, model.layout
    seen = normalizer.mean.square() + normalizer.std.square()
    ranges = []
    for component in layout.components:
        if component.kind == "add":
            square = seen[layout.encoded_slices(model.model.encoding)[component.name]].sum()
            # Nothing seen, as before training: nothing to compare with.
            largest = torch.where(square > 0, limit**2 * square, torch.inf)
            ranges.append((layout.slices[component.name], largest))
    return ranges


def _good(model: TensorDictModuleBase, states: Tensor, ranges: list[tuple[slice, Tensor]]) -> Tensor:
    """Which states ``[*B, N, 13]`` are finite and in range, ``[*B]``."""
    good = states.isfinite().flatten(-2).all(-1)
    if isinstance(model, Predictor):
        states = model.frame.recentered(states)
    for where, largest in ranges:
        good &= (states[..., where].square().sum(-1) <= largest).all(-1)
    return good


def _check(state: Tensor, actions: Tensor, parameters: TensorDictBase | None) -> None:
    if state.ndim < 2 or actions.ndim < 2 or state.shape[:-2] != actions.shape[:-2]:
        raise ValueError(
            f"rollout needs a state [*B, N, 13] and actions [*B, T, A] with the same *B,"
            f" got {list(state.shape)} and {list(actions.shape)}."
        )
    for what, given in (("state", state), ("actions", actions), ("parameters", parameters)):
        if given is not None:
            require_finite(given, what)
