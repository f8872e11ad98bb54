"""Feed a model its own predictions, step after step."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_gn.modules import BoundForwardModel


def predict(model: TensorDictModuleBase, state: Tensor, action: Tensor) -> Tensor:
    """Predict one step with a bound model, whatever its keys.

    Args:
        model: reads ``(state, action)`` at its first two ``in_keys`` and writes the
            next state at its first ``out_keys``.
        state: ``[*B, N, 13]``.
        action: ``[*B, A]``.

    Returns:
        ``[*B, N, 13]`` next states.
    """
    state_key, action_key = model.in_keys[:2]
    # A key may be nested; set() splits it.
    tensordict = TensorDict(batch_size=state.shape[:-2])
    tensordict.set(state_key, state)
    tensordict.set(action_key, action)
    return model(tensordict).get(model.out_keys[0])


def rollout(model: TensorDictModuleBase, state: Tensor, actions: Tensor) -> Tensor:
    """States that a model predicts from a start state under a sequence of actions.

    Differentiable in the state, the actions and the model's weights, through
    every step; open :func:`torch.no_grad` around it where no gradient is wanted.

    Args:
        model: bound forward model (``in_keys`` state and action, ``out_keys`` next state).
        state: ``[*B, N, 13]`` start states.
        actions: ``[*B, T, A]`` controls; ``actions[..., t, :]`` leads from state ``t`` to ``t + 1``.

    Returns:
        ``[*B, T + 1, N, 13]``; the first is the start state itself.

    Raises:
        ValueError: if the batch shapes of ``state`` and ``actions`` differ.
    """
    if state.ndim < 2 or actions.ndim < 2 or state.shape[:-2] != actions.shape[:-2]:
        raise ValueError(
            f"rollout needs a state [*B, N, 13] and actions [*B, T, A] with the same *B,"
            f" got {list(state.shape)} and {list(actions.shape)}."
        )
    if isinstance(model, BoundForwardModel):
        return model.rollout(state, actions)
    states = [state]
    for action in actions.unbind(-2):
        states.append(predict(model, states[-1], action))
    return torch.stack(states, dim=-3)
