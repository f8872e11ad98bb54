"""Short-horizon actor-critic: policy, value and model learn from the policy's own episodes, round by round."""

from torchrl_gn.actor_critic.optimizer import ActorCriticOptimizer as ActorCriticOptimizer
from torchrl_gn.actor_critic.options import ActorCriticOptions as ActorCriticOptions
from torchrl_gn.actor_critic.options import EvaluationEpisodes as EvaluationEpisodes
from torchrl_gn.actor_critic.options import FirstTrajectories as FirstTrajectories
from torchrl_gn.actor_critic.rounds import Rounds as Rounds
from torchrl_gn.actor_critic.suite_task import SuiteActorCriticTask as SuiteActorCriticTask
from torchrl_gn.actor_critic.target_squares import TargetSquares as TargetSquares
from torchrl_gn.actor_critic.task import ActorCriticTask as ActorCriticTask
from torchrl_gn.actor_critic.trainer import ActorCritic as ActorCritic
from torchrl_gn.actor_critic.trajectories import WINDOW as WINDOW
from torchrl_gn.actor_critic.trajectories import colored_noise as colored_noise
from torchrl_gn.actor_critic.trajectories import exploring as exploring
from torchrl_gn.actor_critic.trajectories import play as play
from torchrl_gn.actor_critic.trajectories import unbroken as unbroken
from torchrl_gn.actor_critic.trajectories import windows as windows
