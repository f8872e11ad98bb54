"""Loss of a forward model of observations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.objectives.checks import (
    importance_weights,
    read_entries,
    require_fitted,
    require_some,
    require_steps,
    require_unpadded,
)
from torchrl_gn.policies import LearnedReward, ObservationModel

UPDATE_NORMALIZERS = (
    "Call update_normalizers(observation, action, next_observation) of the Agent, or of the model, with collected"
    " transitions first."
)


class ObservationModelLoss(LossModule):
    """Squared error of predicted observation changes, and of rewards (paper, "Model-based reinforcement learning").

    Errors are in standard deviations of each dimension's change; constant dimensions are left out. Gradients reach the
    weights of the model and of a learned reward.

    Input: ``observation`` ``[*B, O]``, ``action`` ``[*B, A]``, ``("next", "observation")`` and, with a learned reward,
    ``("next", "reward")`` ``[*B, 1]``.

    Output: the scalar ``loss_model`` and, with a learned reward, ``loss_reward``. With ``priority_weight`` ``[*B]``, as
    a ``PrioritizedSampler`` gives it, means are weighted, and each transition's losses together are written to the
    batch as ``td_error`` ``[*B, 1]``.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that :meth:`set_keys` can change; ``reward`` is read under ``"next"``."""

        reward: NestedKey = "reward"
        priority: NestedKey = "td_error"
        priority_weight: NestedKey = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    model: ObservationModel
    reward: LearnedReward | None

    def __init__(self, model: ObservationModel, reward: LearnedReward | None = None) -> None:
        super().__init__()
        self.model, self.reward = model, reward

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        pass

    @property
    def in_keys(self) -> list[NestedKey]:
        reward = [] if self.reward is None else [unravel_key(("next", self.tensor_keys.reward))]
        return [*self.model.in_keys, *self.model.out_keys, *reward]

    @property
    def out_keys(self) -> list[str]:
        return ["loss_model", *([] if self.reward is None else ["loss_reward"])]

    @dispatch()
    @without_autocast
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the losses of transitions.

        Raises:
            ValueError: for NaN, Inf, a wrong shape or an empty batch.
            RuntimeError: if the model's normalisers have seen no data.
        """
        require_fitted(self, self.model, remedy=UPDATE_NORMALIZERS)
        require_steps(type(self).__name__, tensordict)
        require_unpadded(type(self).__name__, tensordict)
        require_some(type(self).__name__, tensordict)
        observation, action, next_observation, *rewards = read_entries(self, tensordict, self.in_keys)
        inverse = torch.where(self.model.change_std > 0, 1 / self.model.change_std, 0).to(observation.dtype)
        target = (next_observation - observation) * inverse
        error = (self.model.normalized_change(observation, action) - target) * (inverse > 0)
        count = (inverse > 0).sum().clamp(min=1)
        errors = {"loss_model": error.square().sum(-1) / count}
        if self.reward is not None:
            predicted = self.reward(observation, action, next_observation)
            if rewards[0].shape != predicted.shape:
                raise ValueError(
                    f"{self.in_keys[-1]!r} must be {list(predicted.shape)} as the predicted rewards, got"
                    f" {list(rewards[0].shape)}."
                )
            errors["loss_reward"] = (predicted - rewards[0]).square().squeeze(-1)
        weights = importance_weights(self, tensordict, observation.shape[:-1])
        if weights is None:
            return TensorDict({name: each.mean() for name, each in errors.items()}, [])
        total = cast(Tensor, sum(errors.values()))
        tensordict.set(self.tensor_keys.priority, total.detach().unsqueeze(-1))
        return TensorDict({name: (weights * each).sum() / weights.sum() for name, each in errors.items()}, [])
