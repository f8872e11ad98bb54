"""Training loop, optimiser presets, checkpoints, and run folders."""

from torchrl_gn.training.budget import Budget as Budget
from torchrl_gn.training.checkpoint import Checkpoint as Checkpoint
from torchrl_gn.training.checkpoint import CheckpointError as CheckpointError
from torchrl_gn.training.checkpoint import load_pretrained as load_pretrained
from torchrl_gn.training.checkpoint import package_versions as package_versions
from torchrl_gn.training.checkpoint import pretrained_names as pretrained_names
from torchrl_gn.training.checkpoint import save_checkpoint as save_checkpoint
from torchrl_gn.training.fit import History as History
from torchrl_gn.training.fit import fit as fit
from torchrl_gn.training.fit_physics import fit_physics as fit_physics
from torchrl_gn.training.off_policy import OffPolicyTrainer as OffPolicyTrainer
from torchrl_gn.training.off_policy import mean_return as mean_return
from torchrl_gn.training.optimizers import ScheduledOptimizer as ScheduledOptimizer
from torchrl_gn.training.optimizers import make_agent_optimizer as make_agent_optimizer
from torchrl_gn.training.optimizers import make_optimizer as make_optimizer
from torchrl_gn.training.ray_cluster import RayCluster as RayCluster
from torchrl_gn.training.run_folder import RunFolder as RunFolder
from torchrl_gn.training.run_folder import plain_config as plain_config
from torchrl_gn.training.tracking import Tracker as Tracker
from torchrl_gn.training.trainer import Progress as Progress
from torchrl_gn.training.trainer import Trainer as Trainer
from torchrl_gn.training.workers import Workers as Workers
from torchrl_gn.training.workers import join_workers as join_workers
