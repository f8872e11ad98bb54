"""Play episodes and cut them into trajectories for training."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_gn.envs import SceneEnv, SuiteTaskEnv
from torchrl_gn.envs.starts import for_learning
from torchrl_gn.policies import BoundedPolicy

WINDOW = 50
"""Steps of a training trajectory."""


def play(
    env: SceneEnv | SuiteTaskEnv,
    policy: Callable[[TensorDictBase], TensorDictBase],
    *,
    episodes: int,
    steps: int,
) -> TensorDict:
    """Play episodes ``[M, T]`` in MuJoCo from new starts. Only the policy adds exploration.

    Args:
        policy: writes ``action`` ``[M, A]`` within the environment's bounds.
        episodes: ``M``; for the suite's environment, its number of environments.
        steps: ``T``, control steps.
    """
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        env = cast(SceneEnv, for_learning(env))
        start = env.reset(TensorDict(batch_size=[episodes]))
        return cast(
            TensorDict, env.rollout(steps, policy, tensordict=start, auto_reset=False, break_when_any_done=False)
        )


def exploring(
    policy: BoundedPolicy, *, episodes: int, steps: int, color: float
) -> Callable[[TensorDictBase], TensorDictBase]:
    """Return a policy for one :func:`play` that explores by :func:`colored_noise`, drawn by torch's generator."""
    noise = iter(colored_noise(steps, (episodes, len(policy.middle)), color))

    def act(tensordict: TensorDictBase) -> TensorDictBase:
        target = tensordict["target"] if policy.targeted else None
        return tensordict.set("action", policy.sample(tensordict["state"], target=target, noise=next(noise))[0])

    return act


def with_others(
    policy: Callable[[TensorDictBase], TensorDictBase],
    others: Sequence[tuple[slice, Callable[[TensorDictBase], TensorDictBase]]],
) -> Callable[[TensorDictBase], TensorDictBase]:
    """Return a policy for one :func:`play` that lets others act in some of the episodes.

    Args:
        others: pairs of episodes and the policy or planner that acts in them. The latter reads only ``state``,
            ``target`` and its own entry ``plan``.
    """
    plans: dict[int, TensorDictBase] = {}

    def act(tensordict: TensorDictBase) -> TensorDictBase:
        action = policy(tensordict)["action"].clone()
        for index, (episodes, other) in enumerate(others):
            seen = cast(TensorDictBase, tensordict[episodes]).select("state", "target", strict=False)
            after = other(seen.update({"plan": plans[index]}) if index in plans else seen)
            if "plan" in after.keys():
                plans[index] = cast(TensorDictBase, after["plan"])
            action[episodes] = after["action"]
        return tensordict.set("action", action)

    return act


def colored_noise(steps: int, shape: tuple[int, ...], color: float) -> Tensor:
    r"""Draw Gaussian noise ``[steps, *shape]`` of unit variance with power spectrum :math:`f^{-color}`.

    A ``color`` of 0 is white, 1 pink, 2 red. Pink noise explores all time scales at once (Eberhard et al. 2023); white
    noise averages out and hardly moves a body.
    """
    frequencies = torch.fft.rfftfreq(steps)
    frequencies[0] = frequencies[1] if steps > 1 else 1.0  # an episode's mean varies as much as its slowest wave
    scale = frequencies.pow(-color / 2).view(-1, *[1] * len(shape))
    noise = torch.fft.irfft(scale * torch.fft.rfft(torch.randn(steps, *shape), dim=0), n=steps, dim=0)
    double = torch.full_like(scale, 2.0)  # each wave also stands for its negative frequency
    double[0] = 1
    if steps % 2 == 0:
        double[-1] = 1
    return noise / (double * scale.square()).sum().div(steps).sqrt()


def windows(state: Tensor, action: Tensor, reward: Tensor, target: Tensor | None = None) -> TensorDict:
    """Cut trajectories into windows of :data:`WINDOW` steps, ``[K * (T // WINDOW)]``; drop the remainder.

    Args:
        state: ``[K, T + 1, N, 13]``.
        action: ``[K, T, A]``.
        reward: ``[K, T, 1]``, observed.
        target: ``[K, 3]``, one per episode, in tasks with a target.
    """
    first = range(0, action.shape[1] - WINDOW + 1, WINDOW)
    parts = {
        "state": torch.cat([state[:, at : at + WINDOW + 1] for at in first]),
        "action": torch.cat([action[:, at : at + WINDOW].float() for at in first]),
        "reward": torch.cat([reward[:, at : at + WINDOW] for at in first]),
    }
    if target is not None:
        parts["target"] = target.repeat(len(first), 1)
    return TensorDict(parts, [len(parts["action"])])


def unbroken(played: TensorDict) -> TensorDict:
    """Drop episodes of ``[M, T]`` whose simulation became unstable."""
    return played[~cast(Tensor, played["next", "terminated"]).flatten(1).any(1)]
