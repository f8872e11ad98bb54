"""Logs of robots that joint encoders know: files, graphs, trajectories, simulated logs."""

from torchrl_gn.data.logs.logged_trajectories import LogReport, log_trajectories
from torchrl_gn.data.logs.robot_log import RobotLog, log_chain
from torchrl_gn.data.logs.robot_log_files import load_robot_log
from torchrl_gn.data.logs.simulated_log import simulate_log

__all__ = ["LogReport", "RobotLog", "load_robot_log", "log_chain", "log_trajectories", "simulate_log"]
