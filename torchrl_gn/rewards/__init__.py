"""Differentiable task rewards on states, for environments, planners and losses."""

from torchrl_gn.rewards.balance import Balance as Balance
from torchrl_gn.rewards.bodies import find_body as find_body
from torchrl_gn.rewards.registry import available_rewards as available_rewards
from torchrl_gn.rewards.registry import make_reward as make_reward
from torchrl_gn.rewards.reward import Reward as Reward
