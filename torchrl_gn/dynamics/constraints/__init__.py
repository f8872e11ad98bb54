"""Projection of predicted changes onto joint constraints."""

from torchrl_gn.dynamics.constraints.anchor_estimation import AnchorEstimator as AnchorEstimator
from torchrl_gn.dynamics.constraints.generalized_coordinates import GeneralizedProjection as GeneralizedProjection
from torchrl_gn.dynamics.constraints.generalized_coordinates import make_projection as make_projection
from torchrl_gn.dynamics.constraints.maximal_coordinates import MaximalProjection as MaximalProjection
from torchrl_gn.dynamics.constraints.maximal_coordinates import position_weight as position_weight
