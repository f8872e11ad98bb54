"""Simulation and data: random controls, start states, data sets, replay buffers."""

from torchrl_gn.data.collect import collect_trajectories
from torchrl_gn.data.controls import spline_controls
from torchrl_gn.data.dataset import TrajectoryDataset, create_dataset, load_dataset
from torchrl_gn.data.errors import DatasetError, UnstableSimulationError
from torchrl_gn.data.logs import LogReport, RobotLog, load_robot_log, log_chain, log_trajectories, simulate_log
from torchrl_gn.data.replay import TrajectoryStorage, WindowSampler, trajectory_buffer
from torchrl_gn.data.simulate import Simulator
from torchrl_gn.data.start_states import sample_start_states

__all__ = [
    "DatasetError",
    "LogReport",
    "RobotLog",
    "Simulator",
    "TrajectoryDataset",
    "TrajectoryStorage",
    "UnstableSimulationError",
    "WindowSampler",
    "collect_trajectories",
    "create_dataset",
    "load_dataset",
    "load_robot_log",
    "log_chain",
    "log_trajectories",
    "sample_start_states",
    "simulate_log",
    "spline_controls",
    "trajectory_buffer",
]
