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

WINDOW = 50
"""Steps of a trajectory that the model learns from."""


def play(
    env: SceneEnv | SuiteTaskEnv,
    policy: Callable[[TensorDictBase], TensorDictBase],
    *,
    episodes: int,
    steps: int,
    explore: bool,
) -> TensorDict:
    """Play episodes ``[M, T]`` in MuJoCo, from new starts.

    Args:
        policy: writes ``action`` ``[M, A]``, in the range of the environment.
        episodes: ``M``; those of the suite's environment are as many as it has.
        steps: ``T``, control steps.
        explore: by TorchRL's exploration type RANDOM, or else DETERMINISTIC.
    """
    kind = ExplorationType.RANDOM if explore else ExplorationType.DETERMINISTIC
    with torch.no_grad(), set_exploration_type(kind):
        env = cast(SceneEnv, for_learning(env))
        start = env.reset(TensorDict(batch_size=[episodes]))
        return cast(
            TensorDict, env.rollout(steps, policy, tensordict=start, auto_reset=False, break_when_any_done=False)
        )


def windows(state: Tensor, action: Tensor, reward: Tensor | None = None, target: Tensor | None = None) -> TensorDict:
    """Cut trajectories into those of :data:`WINDOW` steps, ``[K * (T // WINDOW)]``; the rest of each is left out.

    Args:
        state: ``[K, T + 1, N, 13]``.
        action: ``[K, T, A]``.
        reward: ``[K, T, 1]`` that was paid, if it is to be learned.
        target: ``[K, 3]`` of the episodes, if they have one.
    """
    first = range(0, action.shape[1] - WINDOW + 1, WINDOW)
    parts = {
        "state": torch.cat([state[:, at : at + WINDOW + 1] for at in first]),
        "action": torch.cat([action[:, at : at + WINDOW].float() for at in first]),
    }
    if reward is not None:
        parts["reward"] = torch.cat([reward[:, at : at + WINDOW] for at in first])
    if target is not None:
        parts["target"] = target.repeat(len(first), 1)
    return TensorDict(parts, [len(parts["action"])])


def unbroken(played: TensorDict) -> TensorDict:
    """Episodes ``[M, T]`` without those whose simulation became unstable."""
    return played[~cast(Tensor, played["next", "terminated"]).flatten(1).any(1)]
