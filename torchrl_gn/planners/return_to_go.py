"""What TorchRL's MPPI weighs its candidates by."""

from __future__ import annotations

from typing import cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

_LEAST_SPREAD = 1e-12  # where all candidates are alike
_FAR = 20.0  # times as far below the best as the upper quartile is: unstable, say


class ReturnToGo(TensorDictModuleBase):
    r"""Score candidates by what they bring from each step on, for :class:`torchrl.modules.MPPIPlanner`.

    .. math:: a_{kt} = \frac{R_{kt} - \max_j R_{jt}}{\mathrm{std}_j\, R_{jt}} \qquad R_{kt} = \sum_{s \ge t} r_{ks}

    MPPI weighs candidates by the exponential of this times its temperature. Divided by their spread the same
    temperature does for rewards of any size; less the best, nothing overflows. Candidates that are far off (unstable
    ones) have no part in the spread, beside which all others would be alike.

    Reads ``("next", "reward")`` ``[*B, K, H, 1]`` of ``K`` candidates; writes ``advantage`` of the same shape, 0 for
    the best and below for the others. Differentiable, nothing is detached.

    Example:
        >>> from torchrl.modules import MPPIPlanner
        >>> from torchrl_gn.envs import SceneEnv
        >>> from torchrl_gn.rewards import make_reward
        >>> from torchrl_gn.scenes import load_scene
        >>> scene = load_scene("pendulum")
        >>> env = SceneEnv(scene, make_reward("balance", scene), seed=0)
        >>> sizes = dict(planning_horizon=5, optim_steps=2, num_candidates=8, top_k=4)
        >>> env.rollout(3, MPPIPlanner(env, ReturnToGo(), temperature=5.0, **sizes))["action"].shape
        torch.Size([3, 1])
    """

    def __init__(self) -> None:
        super().__init__()
        self.in_keys: list[NestedKey] = [("next", "reward")]
        self.out_keys: list[NestedKey] = ["advantage"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``advantage`` into the TensorDict and return it."""
        reward = cast(Tensor, tensordict.get(("next", "reward")))
        returns = reward.flip(-2).cumsum(-2).flip(-2)
        best = returns.amax(-3, keepdim=True)
        reach = best - returns.detach().quantile(0.75, dim=-3, keepdim=True)
        near = best - returns <= _FAR * reach
        count = near.sum(-3, keepdim=True)
        mean = torch.where(near, returns, 0.0).sum(-3, keepdim=True) / count
        squares = torch.where(near, returns - mean, 0.0).square().sum(-3, keepdim=True)
        spread = (squares / (count - 1).clamp(min=1)).clamp(min=_LEAST_SPREAD**2).sqrt()
        return tensordict.set("advantage", (returns - best) / spread)
