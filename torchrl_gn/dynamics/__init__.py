"""Forward models: weights, predictors of a scene, and their executors."""

from torchrl_gn.dynamics.export import export_step as export_step
from torchrl_gn.dynamics.model import ForwardModel as ForwardModel
from torchrl_gn.dynamics.predictor import Predictor as Predictor
from torchrl_gn.dynamics.recurrent_predictor import RecurrentPredictor as RecurrentPredictor
from torchrl_gn.dynamics.specialized import SpecializedPredictor as SpecializedPredictor
from torchrl_gn.dynamics.specialized import specialize as specialize
from torchrl_gn.dynamics.unseen_features import UnseenFeatureWarning as UnseenFeatureWarning
