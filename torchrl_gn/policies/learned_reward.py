"""Reward as a network, for tasks whose reward is not known as a function."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torchrl.modules import MLP


class LearnedReward(nn.Module):
    """Reward of a step from observations and action, ``r(x, a, x')``, differentiable in all three.

    Args:
        num_observations: length ``O`` of an observation.
        num_actions: number of actions ``A``.
        hidden: hidden sizes.
    """

    def __init__(self, num_observations: int, num_actions: int, hidden: Sequence[int] = (128, 128)) -> None:
        super().__init__()
        self.mlp = MLP(2 * num_observations + num_actions, 1, num_cells=list(hidden), activation_class=nn.SiLU)

    def forward(self, observation: Tensor, action: Tensor, next_observation: Tensor) -> Tensor:
        """Reward ``[*B, 1]`` of observations ``[*B, O]``, actions ``[*B, A]`` and next observations ``[*B, O]``."""
        return self.mlp(torch.cat((observation, action, next_observation), dim=-1))
