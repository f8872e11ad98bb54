"""Planners: MPC by gradients, by sampling and by iLQG."""

from torchrl_gn.planners.gradient_planner import GradientPlanner as GradientPlanner
from torchrl_gn.planners.guarded import Guarded as Guarded
from torchrl_gn.planners.ilqg import ILQGPlanner as ILQGPlanner
from torchrl_gn.planners.model_planner import ModelPlanner as ModelPlanner
from torchrl_gn.planners.plan_ahead import PlanAhead as PlanAhead
from torchrl_gn.planners.return_to_go import ReturnToGo as ReturnToGo
from torchrl_gn.planners.sampling_planner import SamplingPlanner as SamplingPlanner
from torchrl_gn.planners.terminal_reward import TerminalReward as TerminalReward
