"""Learning of a reward function from observed rewards."""

from __future__ import annotations

from typing import cast

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_gn.checks import check_counts, checked_seed
from torchrl_gn.finite import require_all_finite
from torchrl_gn.maths.normalizer import unchanged_on_error
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.networks.core import dtype_of
from torchrl_gn.networks.layer_norm_mlp import renormalize
from torchrl_gn.policies.state_reward import StateReward
from torchrl_gn.scenes.checked_trajectories import check_episodes, check_numbers
from torchrl_gn.training.fit_batches import fit_batches
from torchrl_gn.training.gradients import with_gradients
from torchrl_gn.training.optimizers import make_optimizer


@without_autocast
@with_gradients
def fit_reward(
    reward: StateReward,
    data: TensorDictBase,
    *,
    steps: int = 1000,
    batch_size: int = 256,
    lr: float = 1e-3,
    seed: int = 0,
) -> float:
    """Fit a reward, in place, to observed rewards; return the mean squared error of the last tenth, in variances.

    Normalisers are refitted to these data alone, as speeds and rewards grow while a policy learns.

    Args:
        data: ``[K]``: ``state`` ``[K, T + 1, N, 13]``, ``action`` ``[K, T, A]``, ``reward`` ``[K, T, 1]`` and, for a
            reward with a target, ``target`` ``[K, 3]``.
        steps: optimiser steps.
        lr: peak learning rate of Adam, cosine to 0.
        seed: seed of the batches.

    Raises:
        KeyError: an entry is missing.
        ValueError: an entry is misshapen, or has NaN or Inf, or an episode ends (``("next", "done")``) inside a row.
        FloatingPointError: the gradient is not finite; no weight changes at that step.
    """
    check_counts(steps=steps, batch_size=batch_size)
    optimizer = make_optimizer(reward.network, "adam", lr=lr)
    generator = torch.Generator(reward.scale.device).manual_seed(checked_seed(seed))
    data = data.to(reward.scale.device)
    state, action, rewards = (cast(Tensor, data[key]) for key in ("state", "action", "reward"))
    if rewards.shape != (*action.shape[:-1], 1) or state.shape[:2] != (len(action), action.shape[1] + 1):
        shapes = f"{list(state.shape)}, {list(action.shape)} and {list(rewards.shape)}"
        raise ValueError(f"state [K, T + 1, N, 13], action [K, T, A] and reward [K, T, 1] do not fit: {shapes}.")
    if action.shape[2:] != reward.scale.shape:
        raise ValueError(f"action must be [K, T, {len(reward.scale)}] for {reward}, got {list(action.shape)}.")
    check_episodes(data)
    check_numbers(state, action, reward.features.scene.layout)
    target = cast(Tensor, data["target"]) if reward.features.target else None
    if target is not None and target.shape != (len(state), 3):
        raise ValueError(f"target must be [K, 3], one of each row, got {list(target.shape)} for {len(state)} rows.")
    known = {"reward": rewards} if target is None else {"reward": rewards, "target": target}
    require_all_finite({f"{name!r} of the data": value for name, value in known.items()})
    target = None if target is None else target.unsqueeze(1).expand(*state.shape[:2], 3)
    rewards = rewards.flatten(0, 1).double()
    with torch.no_grad(), unchanged_on_error(reward):
        features = reward.features.refit(state, target, dtype_of(reward.network))
        inputs = reward.inputs(features[:, :-1], action, features[:, 1:]).flatten(0, 1)
        renormalize([reward.network], reward.normalizer, rewards)
    normalized = reward.normalizer(rewards, inputs.dtype)
    sizes = {"steps": steps, "batch_size": batch_size, "generator": generator}
    losses = fit_batches(reward.network, inputs, normalized, optimizer, **sizes)
    return float(losses[-max(1, steps // 10) :].mean())
