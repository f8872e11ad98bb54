"""Returns of evaluation episodes over training."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type


@dataclass
class LearningCurve:
    """Mean returns, each with the frames, updates and seconds before it."""

    frames: list[float] = field(default_factory=list)
    updates: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)


@torch.no_grad()
def mean_return(env: EnvBase, policy: TensorDictModuleBase, steps: int, *, seed: int = 0) -> float:
    """Return the mean return of one episode per environment ``[num_envs]``, without exploration.

    Args:
        env: the environments; episodes may end before ``steps``.
        policy: the policy.
        steps: control steps of an episode.
        seed: seed of the episodes, the same for every policy to compare.
    """
    env.set_seed(seed)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        rollout = env.rollout(steps, policy, break_when_any_done=False, break_when_all_done=True)
    reward, done = rollout["next", "reward"], rollout["next", "done"]
    # Environments reset themselves when done: count the first episode only.
    first_episode = torch.cat((torch.ones_like(done[:, :1]), (~done[:, :-1]).cumprod(1).bool()), dim=1)
    return float((reward * first_episode).sum(1).mean())
