"""Simulation and data: random controls, start states, data sets, replay buffers."""

from torchrl_gn.data.collect import collect_trajectories as collect_trajectories
from torchrl_gn.data.controls import spline_controls as spline_controls
from torchrl_gn.data.dataset import TrajectoryDataset as TrajectoryDataset
from torchrl_gn.data.dataset import create_dataset as create_dataset
from torchrl_gn.data.dataset import load_dataset as load_dataset
from torchrl_gn.data.dataset_files import DatasetError as DatasetError
from torchrl_gn.data.logs import JointDelay as JointDelay
from torchrl_gn.data.logs import LogInspection as LogInspection
from torchrl_gn.data.logs import LogReport as LogReport
from torchrl_gn.data.logs import RobotLog as RobotLog
from torchrl_gn.data.logs import channel_weights as channel_weights
from torchrl_gn.data.logs import inspect_log as inspect_log
from torchrl_gn.data.logs import load_robot_log as load_robot_log
from torchrl_gn.data.logs import log_trajectories as log_trajectories
from torchrl_gn.data.logs import log_tree as log_tree
from torchrl_gn.data.logs import simulate_log as simulate_log
from torchrl_gn.data.random_controls import random_controls as random_controls
from torchrl_gn.data.replay import TrajectoryStorage as TrajectoryStorage
from torchrl_gn.data.replay import WindowSampler as WindowSampler
from torchrl_gn.data.replay import trajectory_buffer as trajectory_buffer
from torchrl_gn.data.simulate import Simulator as Simulator
from torchrl_gn.data.simulate import UnstableSimulationError as UnstableSimulationError
from torchrl_gn.data.start_poses import StartPoses as StartPoses
from torchrl_gn.data.start_poses import StartPoseWarning as StartPoseWarning
from torchrl_gn.data.start_states import sample_start_states as sample_start_states
from torchrl_gn.scenes.actuator_kinds import actuator_kind as actuator_kind
