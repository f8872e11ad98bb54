"""Policies, values and learned rewards, over observations, graphs and the states of a scene."""

from torchrl_gn.policies.agent import Agent as Agent
from torchrl_gn.policies.agent import GraphPolicy as GraphPolicy
from torchrl_gn.policies.agent import LearnedReward as LearnedReward
from torchrl_gn.policies.agent import OutputNormalization as OutputNormalization
from torchrl_gn.policies.bounded_policy import BoundedPolicy as BoundedPolicy
from torchrl_gn.policies.graph_state_policy import GraphStatePolicy as GraphStatePolicy
from torchrl_gn.policies.observation_model import ObservationModel as ObservationModel
from torchrl_gn.policies.observation_model import SwimmerObservation as SwimmerObservation
from torchrl_gn.policies.observation_network import ObservationNetwork as ObservationNetwork
from torchrl_gn.policies.state_features import StateFeatures as StateFeatures
from torchrl_gn.policies.state_features import task_invariances as task_invariances
from torchrl_gn.policies.state_policy import StatePolicy as StatePolicy
from torchrl_gn.policies.state_reward import StateReward as StateReward
from torchrl_gn.policies.state_value import StateValue as StateValue
