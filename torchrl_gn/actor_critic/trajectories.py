"""Play episodes, and cut them into the trajectories that the model learns from."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_gn.envs import SceneEnv, SuiteTaskEnv
from torchrl_gn.envs.starts import for_learning
from torchrl_gn.planners import BoundedPolicy

WINDOW = 50
"""Steps of a trajectory that the model learns from."""


def play(
    env: SceneEnv | SuiteTaskEnv,
    policy: Callable[[TensorDictBase], TensorDictBase],
    *,
    episodes: int,
    steps: int,
) -> TensorDict:
    """Play episodes ``[M, T]`` in MuJoCo, from new starts, without exploration but for that of the policy.

    Args:
        policy: writes ``action`` ``[M, A]``, in the range of the environment.
        episodes: ``M``; those of the suite's environment are as many as it has.
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
    """The policy of :func:`play` that explores by :func:`colored_noise`, from torch's generator, for one rollout."""
    rest = iter(colored_noise(steps, (episodes, len(policy.middle)), color))

    def act(tensordict: TensorDictBase) -> TensorDictBase:
        target = tensordict["target"] if policy.targeted else None
        return tensordict.set("action", policy.sample(tensordict["state"], target=target, noise=next(rest))[0])

    return act


def colored_noise(steps: int, shape: tuple[int, ...], color: float) -> Tensor:
    r"""Gaussian noise ``[steps, *shape]`` of unit variance whose power falls with the frequency as :math:`f^{-color}`.

    0 is white, 1 pink, 2 red. Pink noise explores at all scales of time at once (Eberhard et al. 2023): white noise of
    every control step hardly moves a body that averages it out.
    """
    frequencies = torch.fft.rfftfreq(steps)
    frequencies[0] = frequencies[1] if steps > 1 else 1.0  # the mean of an episode varies as its slowest wave
    scale = frequencies.pow(-color / 2).view(-1, *[1] * len(shape))
    noise = torch.fft.irfft(scale * torch.fft.rfft(torch.randn(steps, *shape), dim=0), n=steps, dim=0)
    double = torch.full_like(scale, 2.0)  # waves that stand for themselves and their mirror image
    double[0] = 1
    if steps % 2 == 0:
        double[-1] = 1
    return noise / (double * scale.square()).sum().div(steps).sqrt()


def windows(state: Tensor, action: Tensor, reward: Tensor, target: Tensor | None = None) -> TensorDict:
    """Cut trajectories into those of :data:`WINDOW` steps, ``[K * (T // WINDOW)]``; the rest of each is left out.

    Args:
        state: ``[K, T + 1, N, 13]``.
        action: ``[K, T, A]``.
        reward: ``[K, T, 1]`` that was paid.
        target: ``[K, 3]`` of the episodes, if they have one.
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
    """Episodes ``[M, T]`` without those whose simulation became unstable."""
    return played[~cast(Tensor, played["next", "terminated"]).flatten(1).any(1)]
