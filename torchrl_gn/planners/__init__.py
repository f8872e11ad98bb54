"""Planners (gradient MPC and iLQG), and policies, values and rewards over the states of a scene."""

from torchrl_gn.planners.bounded_policy import BoundedPolicy as BoundedPolicy
from torchrl_gn.planners.gradient_planner import GradientPlanner as GradientPlanner
from torchrl_gn.planners.graph_state_policy import GraphStatePolicy as GraphStatePolicy
from torchrl_gn.planners.guarded import Guarded as Guarded
from torchrl_gn.planners.ilqg import ILQGPlanner as ILQGPlanner
from torchrl_gn.planners.plan_ahead import PlanAhead as PlanAhead
from torchrl_gn.planners.return_to_go import ReturnToGo as ReturnToGo
from torchrl_gn.planners.state_features import StateFeatures as StateFeatures
from torchrl_gn.planners.state_features import task_invariances as task_invariances
from torchrl_gn.planners.state_policy import StatePolicy as StatePolicy
from torchrl_gn.planners.state_reward import StateReward as StateReward
from torchrl_gn.planners.state_value import StateValue as StateValue
from torchrl_gn.planners.terminal_reward import TerminalReward as TerminalReward
