"""Exploration by novelty: random controls that lead the model to states far from all data."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_gn.dynamics import Predictor

HELD = 20
"""Control steps for which chosen controls are followed before others are chosen."""


@torch.no_grad()
def novelty(
    model: Predictor, features: Callable[[Tensor], Tensor], state: Tensor, controls: Tensor, known: Tensor, repeat: int
) -> Tensor:
    """Return the mean distance ``[K]`` from imagined states to the nearest known ones, in feature space.

    It predicts ``L`` control steps from one state under ``K`` sequences of controls. States that are not finite count
    as known, since the model says nothing there.

    Args:
        features: function from states ``[*B, N, 13]`` to features ``[*B, F]``.
        state: ``[1, N, 13]``.
        controls: ``[K, L, A]``.
        known: features ``[M, F]`` of states in the data.
        repeat: model steps per control step.
    """
    state, distance = state.expand(len(controls), -1, -1), controls.new_zeros(len(controls))
    for action in controls.unbind(1):
        for _ in range(repeat):
            state = model.step(state, action)[0]
        distance += torch.cdist(features(state), known).amin(1).nan_to_num(0.0).to(distance.dtype)
    return distance / controls.shape[1]


def following(choose: Callable[[Tensor], Tensor]) -> Callable[[TensorDictBase], TensorDictBase]:
    """Return a policy for one episode ``[1]`` that follows the controls that ``choose`` returns.

    Args:
        choose: function from a state ``[1, N, 13]`` to controls ``[T, A]`` for the next ``T`` steps; called every ``T``
            steps.
    """
    chosen: Iterator[Tensor] = iter(())

    def act(tensordict: TensorDictBase) -> TensorDictBase:
        nonlocal chosen
        action = next(chosen, None)
        if action is None:
            chosen = iter(choose(tensordict["state"]))
            action = next(chosen)
        return tensordict.set("action", action.unsqueeze(0))

    return act
