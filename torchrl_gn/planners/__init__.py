"""Planners: gradient MPC through the learned model, iLQG on the true physics."""

from torchrl_gn.planners.gradient_planner import GradientPlanner as GradientPlanner
from torchrl_gn.planners.ilqg import ILQGPlanner as ILQGPlanner
from torchrl_gn.planners.plan_ahead import PlanAhead as PlanAhead
from torchrl_gn.planners.return_to_go import ReturnToGo as ReturnToGo
