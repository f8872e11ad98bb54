"""Value learning and behaviour cloning from played episodes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives.value import TDLambdaEstimator

from torchrl_gn.checks import check_counts, checked_seed
from torchrl_gn.finite import require_finite
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.objectives.checks import collected_mask, require_consecutive, require_steps
from torchrl_gn.objectives.episodes_in_rows import fill_padding
from torchrl_gn.policies import StateFeatures, StatePolicy, StateValue
from torchrl_gn.scenes.checked_trajectories import ENDS
from torchrl_gn.training.fit_batches import fit_batches
from torchrl_gn.training.gradients import with_gradients
from torchrl_gn.training.optimizers import make_optimizer

Episodes = TensorDictBase | Sequence[TensorDictBase]

_SMALL = 1e-6  # TorchRL's vectorised returns fail if the weight of the next step is about 0


@dataclass
class ImitationHistory:
    """Errors of :func:`fit_policy` during training."""

    losses: list[float] = field(
        default_factory=list
    )  # mean squared error of scaled actions, of each tenth of the steps


@dataclass
class ValueHistory:
    """Errors of :func:`fit_value` during training."""

    losses: list[float] = field(default_factory=list)  # mean squared error of each iteration, relative to the variance
    explained: float = math.nan  # share of the last targets' variance that the value explains


@without_autocast
@with_gradients
def fit_value(
    value: StateValue,
    episodes: Episodes,
    *,
    lmbda: float = 0.95,
    iterations: int = 30,
    steps: int = 100,
    batch_size: int = 256,
    lr: float = 3e-3,
    seed: int = 0,
) -> ValueHistory:
    r"""Learn the value of the policy that played some episodes, in place, by fitted TD(:math:`\lambda`) iterations.

    Every iteration computes targets with the current value (``TDLambdaEstimator``), then fits the networks to them.
    Episodes that end by a time limit, or with the data, bootstrap from the value of their last state; ``terminated``
    ones do not. A new value's normalisers are fitted first; its first targets bootstrap from the return of the mean
    reward.

    Args:
        episodes: ``[M, T]``, as ``env.rollout`` and collectors give them, or several such of different ``T``: ``state``
            ``[M, T, N, 13]``, ``("next", "state")``, ``("next", "reward")`` ``[M, T, 1]`` and, if any episode ends
            before the last step, ``done``, ``terminated`` or ``truncated`` under ``"next"``. As in TorchRL, an episode
            that is ``done`` has terminated if no other flag is given. Rows that go on elsewhere
            without a flag are refused. A value with a target also reads ``target`` ``[M, T, 3]`` and, if the target
            may move within an episode, ``("next", "target")``. Padding that
            ``("collector", "mask")`` marks does not count. Rewards are not changed; see
            :class:`~torchrl_gn.envs.SceneEnv` for those of unstable steps.
        lmbda: :math:`\lambda` of the targets: 0 looks one step ahead, 1 to the end of the episode.
        iterations: how often targets are computed.
        steps: optimiser steps per iteration.
        lr: peak learning rate of Adam, cosine to 0.
        seed: seed of the batches. Initial weights come from torch's global generator.

    Raises:
        ValueError: an option is out of range, an entry is missing or misshapen, or it has NaN or Inf.
        FloatingPointError: the gradient is not finite; no weight changes at that step.
    """
    if not 0 <= lmbda <= 1:
        raise ValueError(f"lmbda={lmbda} must be from 0 to 1.")
    check_counts(iterations=iterations, steps=steps, batch_size=batch_size)
    optimizer = make_optimizer(value.members, "adam", lr=lr)
    generator = torch.Generator(value.normalizer.mean.device).manual_seed(checked_seed(seed))
    episode_batches = _as_list(episodes)
    targets_read = _targets_read(value.features)
    keys = ("state", ("next", "state"), ("next", "reward"), *targets_read)
    device = value.normalizer.mean.device
    for part in episode_batches:
        require_steps("fit_value", part)
    parts = [
        _require(part, index, (*keys, *_given(part, targets_read))).to(device)
        for index, part in enumerate(episode_batches)
    ]
    for part in parts:
        _check(part)
    value.features.fit(*(_steps(parts, key) for key in ("state", *targets_read)))
    parts = [_transitions(value, part) for part in parts]
    features = _steps(parts, "features")
    network = TensorDictModule(value.of_features, ["features"], ["state_value"])
    fast = value.discount * lmbda > _SMALL
    estimator = TDLambdaEstimator(gamma=value.discount, lmbda=lmbda, value_network=network, vectorized=fast)
    sizes, history = {"steps": steps, "batch_size": batch_size, "generator": generator}, ValueHistory()
    targets = torch.empty(0)
    for iteration in range(iterations):
        targets = _targets(value, estimator, parts)
        if not value.fitted:
            value.normalizer.update(targets)
        plan = {**sizes, "done": iteration * steps, "total": iterations * steps}
        losses = fit_batches(value.normalized, features, value.normalizer(targets), optimizer, **plan)
        history.losses.append(float(losses.mean()))
    with torch.no_grad():
        left = (targets - value.of_features(features)).var() / targets.var()
    history.explained = 1 - float(left)
    return history


@without_autocast
@with_gradients
def fit_policy(
    policy: StatePolicy,
    episodes: Episodes,
    *,
    steps: int = 3000,
    batch_size: int = 256,
    lr: float = 1e-3,
    seed: int = 0,
) -> ImitationHistory:
    """Fit a policy, in place, to the actions of played episodes (behaviour cloning).

    Args:
        episodes: ``[M, T]`` or several such: ``state`` ``[M, T, N, 13]`` and ``action`` ``[M, T, A]``, which counts
            as executed, clamped to the scene's bounds. A policy with a target also reads ``target`` ``[M, T, 3]``.
        steps, batch_size, lr, seed: see :func:`fit_value`.

    Raises:
        ValueError: an option is out of range, an entry is missing or misshapen, or it has NaN or Inf.
        FloatingPointError: the gradient is not finite; no weight changes at that step.
    """
    check_counts(steps=steps, batch_size=batch_size)
    optimizer = make_optimizer(policy.network, "adam", lr=lr)
    generator = torch.Generator(policy.middle.device).manual_seed(checked_seed(seed))
    episode_batches, device = enumerate(_as_list(episodes)), policy.middle.device
    targets = _targets_read(policy.features)
    parts = [_require(part, index, ("state", "action", *targets)).to(device) for index, part in episode_batches]
    state, action, *target = (_steps(parts, key) for key in ("state", "action", *targets))
    if action.shape[1:] != policy.middle.shape:
        raise ValueError(f"The episodes' actions must be [M, T, {len(policy.middle)}], got {list(action.shape)}.")
    policy.features.fit(state, *target)
    features = policy.features(state, next(policy.network.parameters()).dtype, *target)
    varied = policy.half_range > 0
    scaled = torch.where(varied, (action - policy.middle) / policy.half_range, 0.0).clamp(-1, 1).to(features.dtype)
    sizes = {"steps": steps, "batch_size": batch_size, "generator": generator}
    losses = fit_batches(policy.scaled, features, scaled, optimizer, **sizes)
    return ImitationHistory([float(tenth.mean()) for tenth in losses.tensor_split(min(10, steps))])


def _targets_read(features: StateFeatures) -> tuple[str, ...]:
    return ("target",) if features.target else ()


def _given(part: TensorDictBase, keys: Sequence[str]) -> list[tuple[str, str]]:
    """Return the keys of entries after a step, where episodes have some."""
    return [("next", key) for key in keys if part.get(("next", key), None) is not None]


def _as_list(episodes: Episodes) -> list[TensorDictBase]:
    parts = [episodes] if isinstance(episodes, TensorDictBase) else list(episodes)
    if not parts or any(0 in part.shape for part in parts):  # numel() of an empty TensorDict is 1
        raise ValueError("There are no played episodes to learn from.")
    return parts


def _require(part: TensorDictBase, index: int, keys: Sequence) -> TensorDict:
    """Select entries of episodes ``[M, T]``, and a ``mask`` ``[M, T]``, False where they are padding.

    ValueError if one is missing or not finite.
    """
    if part.ndim != 2:
        raise ValueError(f"Episodes must be TensorDicts [M, T], number {index} is {list(part.shape)}.")
    entries, flag_keys, mask = {}, [("next", name) for name in ENDS], collected_mask(part)
    flags = [key for key in flag_keys if part.get(key, None) is not None]
    if flags == flag_keys[:1]:  # TorchRL, too, takes done for terminated if it is alone
        part = cast(TensorDictBase, part.copy()).set(flag_keys[1], part[flag_keys[0]])
    if mask is None:
        mask = torch.ones(part.shape, dtype=torch.bool, device=part.device)
    else:
        part, mask = fill_padding(part, mask, (*keys, *flag_keys), flag_keys[0])
    for key in keys:
        if (entry := part.get(key, None)) is None:
            raise ValueError(f"Episodes number {index} have no entry {key!r}.")
        require_finite(entry, f"{key!r} of episodes number {index}")
        entries[key] = entry
    flags = {
        key: cast(Tensor, flag).reshape(*part.shape, 1).bool()
        for key in flag_keys
        if (flag := part.get(key, None)) is not None
    }
    return TensorDict({**entries, **flags, "mask": mask}, part.shape)


def _steps(parts: Sequence[TensorDict], key: str) -> Tensor:
    """Return an entry of all steps ``[steps, ...]``, without padding."""
    return torch.cat([part[key][part["mask"]] for part in parts])


def _check(part: TensorDict) -> None:
    """Raise ValueError if entries of steps ``[M, T]`` are misshapen, or rows jump; nothing has been fitted yet."""
    reward, state, next_state = part["next", "reward"], part["state"], part["next", "state"]
    if reward.shape != (*part.shape, 1):
        raise ValueError(f"The episodes' rewards must be {[*part.shape, 1]}, got {list(reward.shape)}.")
    if next_state.shape != state.shape:
        raise ValueError(f"The episodes' next states must be {list(state.shape)}, got {list(next_state.shape)}.")
    require_consecutive("fit_value", state, next_state, _ends(part)[0])


def _ends(part: TensorDict) -> tuple[Tensor, Tensor]:
    """Return where episodes of steps ``[M, T]`` end, and where they terminate, bool ``[M, T, 1]``."""
    never = torch.zeros(*part.shape, 1, dtype=torch.bool, device=part["next", "reward"].device)
    flags = {name: part.get(("next", name), never) for name in ENDS}
    done = torch.stack(list(flags.values())).any(0)
    done[:, -1] = True  # end of the data
    return done, flags["terminated"]


def _transitions(value: StateValue, part: TensorDict) -> TensorDict:
    """Return features, rewards and ends of steps ``[M, T]``, as the estimator reads them."""
    dtype = next(value.members.parameters()).dtype
    reward, (done, terminated) = part["next", "reward"], _ends(part)
    with torch.no_grad():
        target = part.get("target", None)
        features = value.features(part["state"], dtype, target)
        next_features = value.features(part["next", "state"], dtype, part.get(("next", "target"), target))
    after = {"features": next_features, "reward": reward.to(dtype), "done": done, "terminated": terminated}
    return TensorDict({"features": features, "mask": part["mask"], "next": after}, part.shape)


@torch.no_grad()
def _targets(value: StateValue, estimator: TDLambdaEstimator, parts: Sequence[TensorDict]) -> Tensor:
    """Compute targets ``[steps, 1]`` of all steps."""
    forever = None
    if not value.fitted:
        rewards = torch.cat([part["next", "reward"][part["mask"]].flatten() for part in parts])
        forever = float(rewards.mean()) / (1 - value.discount) if value.discount < 1 else 0.0
    targets = []
    for part in parts:
        next_value = None if forever is None else torch.full_like(part["next", "reward"], forever)
        target = estimator.value_estimate(part.clone(), next_value=next_value)
        targets.append(cast(Tensor, target)[part["mask"]])
    return torch.cat(targets)
