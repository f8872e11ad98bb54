"""Score of candidates for TorchRL's MPPI."""

from __future__ import annotations

from typing import cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

_MIN_STD = 1e-12  # for equal candidates
_OUTLIER = 20.0  # outliers, such as unstable rollouts, are this many times as far below the best as the upper quartile


class ReturnToGo(TensorDictModuleBase):
    r"""Score of candidates, their normalised return-to-go, for :class:`torchrl.modules.MPPIPlanner`.

    .. math:: a_{kt} = \frac{R_{kt} - \max_j R_{jt}}{\mathrm{std}_j\, R_{jt}} \qquad R_{kt} = \sum_{s \ge t} r_{ks}

    Dividing by the standard deviation, without outliers, makes one temperature fit any reward. Reads
    ``("next", "reward")`` ``[*B, K, H, 1]`` of ``K`` candidates; writes ``advantage`` of the same shape, 0 for the
    best. Differentiable.

    Example:
        >>> from torchrl.modules import MPPIPlanner
        >>> from torchrl_gn.envs import SceneEnv
        >>> from torchrl_gn.scenes import load_scene
        >>> env = SceneEnv(load_scene("pendulum"), seed=0)
        >>> sizes = dict(planning_horizon=5, optim_steps=2, num_candidates=8, top_k=4)
        >>> env.rollout(3, MPPIPlanner(env, ReturnToGo(), temperature=5.0, **sizes))["action"].shape
        torch.Size([3, 1])
    """

    def __init__(self) -> None:
        super().__init__()
        self.in_keys: list[NestedKey] = [("next", "reward")]
        self.out_keys: list[NestedKey] = ["advantage"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        reward = cast(Tensor, tensordict.get(("next", "reward")))
        returns = reward.flip(-2).cumsum(-2).flip(-2)
        best = returns.amax(-3, keepdim=True)
        quartile = best - returns.detach().quantile(0.75, dim=-3, keepdim=True)
        inlier = best - returns <= _OUTLIER * quartile
        count = inlier.sum(-3, keepdim=True)
        mean = torch.where(inlier, returns, 0.0).sum(-3, keepdim=True) / count
        squares = torch.where(inlier, returns - mean, 0.0).square().sum(-3, keepdim=True)
        std = (squares / (count - 1).clamp(min=1)).clamp(min=_MIN_STD**2).sqrt()
        return tensordict.set("advantage", (returns - best) / std)
