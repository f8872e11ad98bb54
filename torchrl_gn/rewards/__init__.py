"""Differentiable task rewards on states, for environments, planners and losses."""

from torchrl_gn.rewards.bodies import Bodies as Bodies
from torchrl_gn.rewards.bodies import find_body as find_body
from torchrl_gn.rewards.distance import Distance as Distance
from torchrl_gn.rewards.distance import Near as Near
from torchrl_gn.rewards.distance import TargetDistance as TargetDistance
from torchrl_gn.rewards.imitate_pose import ImitatePose as ImitatePose
from torchrl_gn.rewards.imitate_pose import arm_reach as arm_reach
from torchrl_gn.rewards.reward import FreezeGoal as FreezeGoal
from torchrl_gn.rewards.reward import Reward as Reward
from torchrl_gn.rewards.reward import WeightedSum as WeightedSum
from torchrl_gn.rewards.suite import SUITE_TASKS as SUITE_TASKS
from torchrl_gn.rewards.suite import Run as Run
from torchrl_gn.rewards.suite import RunUpright as RunUpright
from torchrl_gn.rewards.suite import suite_reward as suite_reward
from torchrl_gn.rewards.tasks import REWARD_TYPES as REWARD_TYPES
from torchrl_gn.rewards.tasks import AngularSpeed as AngularSpeed
from torchrl_gn.rewards.tasks import Balance as Balance
from torchrl_gn.rewards.tasks import Effort as Effort
from torchrl_gn.rewards.tasks import Position as Position
from torchrl_gn.rewards.tasks import Reach as Reach
from torchrl_gn.rewards.tasks import Upright as Upright
from torchrl_gn.rewards.tasks import Velocity as Velocity
from torchrl_gn.rewards.tasks import VerticalDistance as VerticalDistance
from torchrl_gn.rewards.tasks import available_rewards as available_rewards
from torchrl_gn.rewards.tasks import make_reward as make_reward
from torchrl_gn.rewards.tolerance import tolerance as tolerance
