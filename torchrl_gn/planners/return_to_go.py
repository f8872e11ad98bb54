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
    best. A return that is not finite scores minus infinity, or 0 if none is finite. Differentiable.

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
        finite = returns.isfinite()
        best = torch.where(finite, returns, torch.finfo(returns.dtype).min).amax(-3, keepdim=True)
        short = best - torch.where(finite, returns, best)
        quartile = torch.where(finite, short.detach(), torch.inf).quantile(0.25, dim=-3, keepdim=True)
        # With few finite returns the quartile is infinite: none of them is an outlier.
        inlier = finite & ((short <= _OUTLIER * quartile) | ~quartile.isfinite())
        unit = torch.where(inlier, short.detach(), 0.0).amax(-3, keepdim=True)  # squares of returns may overflow
        scaled = torch.where(inlier, short / torch.where(unit > 0, unit, 1.0), 0.0)
        count = inlier.sum(-3, keepdim=True).clamp(min=1)
        mean = scaled.sum(-3, keepdim=True) / count
        squares = torch.where(inlier, scaled - mean, 0.0).square().sum(-3, keepdim=True)
        std = unit * (squares / (count - 1).clamp(min=1)).clamp(min=_MIN_STD**2).sqrt()
        advantage = torch.where(finite, -short / std.clamp(min=_MIN_STD), -torch.inf)
        advantage = torch.where(finite.any(-3, keepdim=True), advantage, 0.0)
        return tensordict.set("advantage", advantage)
