"""Policies and values over observations and graphs."""

from torchrl_gn.policies.agent import Agent as Agent
from torchrl_gn.policies.agent import GraphPolicy as GraphPolicy
from torchrl_gn.policies.agent import LearnedReward as LearnedReward
from torchrl_gn.policies.agent import OutputNormalization as OutputNormalization
from torchrl_gn.policies.observation_model import ObservationModel as ObservationModel
from torchrl_gn.policies.observation_model import SwimmerObservation as SwimmerObservation
from torchrl_gn.policies.observation_network import ObservationNetwork as ObservationNetwork
