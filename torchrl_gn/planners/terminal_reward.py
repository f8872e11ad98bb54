"""Terminal value for plans: the weighted reward of their last state."""

from __future__ import annotations

import math

from torch import Tensor, nn

from torchrl_gn.rewards.reward import Reward
from torchrl_gn.scenes.scene import Scene


class TerminalReward(nn.Module):
    """Value of a state as if the robot stayed there: ``weight`` times the reward of a step from it to itself.

    Use it as the ``terminal`` of environments to plan on. Plans then accept low rewards before a high final one, and so
    leave local optima within their horizon. It needs no learning and knows the task's target. It suits rewards of
    positions and poses; a reward of displacement, such as :class:`~torchrl_gn.rewards.Reach`, is 0 for a robot that
    stays.

    Args:
        reward: the environment's reward.
        weight: number of control steps that the state counts for.

    Raises:
        ValueError: ``weight`` is not above 0 and finite.

    Example:
        >>> import torch
        >>> from torchrl_gn.rewards import make_reward
        >>> from torchrl_gn.scenes import load_scene
        >>> scene = load_scene("cartpole")
        >>> value = TerminalReward(make_reward("balance", scene), scene, weight=50)
        >>> value(torch.zeros(5, scene.num_nodes, 13)).shape
        torch.Size([5, 1])
    """

    reads_task = True

    def __init__(self, reward: Reward, scene: Scene, weight: float) -> None:
        super().__init__()
        if not 0 < weight < math.inf:
            raise ValueError(f"weight must be above 0 and finite, got {weight}")
        self.reward, self.scene, self.weight = reward, scene, float(weight)

    def forward(self, state: Tensor, task: Tensor | None = None) -> Tensor:
        """Return values ``[*B, 1]`` of states ``[*B, N, 13]``."""
        rest_action = state.new_zeros(*state.shape[:-2], self.scene.num_actions)
        if len(self.scene.mocaps):  # a zero mocap pose is not rest
            rest_action = rest_action + state.new_tensor(self.scene.rest_action)
        return self.weight * self.reward(state, rest_action, state, task)
