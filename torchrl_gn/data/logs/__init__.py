"""Logs of joint encoders and of body poses: files, graphs, trajectories, measurements, simulated logs."""

from torchrl_gn.data.logs.log_checks import LogContentWarning as LogContentWarning
from torchrl_gn.data.logs.log_inspection import JointDelay as JointDelay
from torchrl_gn.data.logs.log_inspection import LogInspection as LogInspection
from torchrl_gn.data.logs.log_inspection import inspect_log as inspect_log
from torchrl_gn.data.logs.log_noise import channel_weights as channel_weights
from torchrl_gn.data.logs.logged_trajectories import LogReport as LogReport
from torchrl_gn.data.logs.logged_trajectories import log_trajectories as log_trajectories
from torchrl_gn.data.logs.pose_log import PoseLog as PoseLog
from torchrl_gn.data.logs.pose_log import load_pose_log as load_pose_log
from torchrl_gn.data.logs.pose_trajectories import pose_trajectories as pose_trajectories
from torchrl_gn.data.logs.robot_log import RobotLog as RobotLog
from torchrl_gn.data.logs.robot_log import log_tree as log_tree
from torchrl_gn.data.logs.robot_log_files import load_robot_log as load_robot_log
from torchrl_gn.data.logs.simulated_log import simulate_log as simulate_log
