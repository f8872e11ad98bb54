"""Train a forward model on a CSV log of joint angles, velocities and motor commands, without a simulator.

The picture shows measured and predicted joints of an episode that was held back.
"""

import sys

import numpy as np

import torchrl_gn as gn
from torchrl_gn.data import load_robot_log, log_trajectories, log_tree, simulate_log
from torchrl_gn.evaluation import plot_joints

picture = sys.argv[1] if sys.argv[1:] else "robot_log.png"

# A simulated arm stands in for yours: one row every 20 ms, 60 episodes of 99 rows.
arm = simulate_log(gn.load_scene("acrobot"), episodes=60, steps=100, seed=0)
episode = np.repeat(np.arange(60), arm.length)
rows = np.column_stack([episode, arm.angle, arm.velocity, arm.command])
header = "episode,angle0,angle1,velocity0,velocity1,command0"
np.savetxt("arm.csv", rows, delimiter=",", header=header, comments="")

log = load_robot_log("arm.csv", timestep=arm.timestep)
robot = log_tree(log, "arm", commands=[[], [0]], history=4)  # only the elbow has a motor, and it lags
train, report = log_trajectories(log, steps=60, history=4, episodes=range(50), overlap=True)
test, _ = log_trajectories(log, steps=60, history=4, episodes=range(50, 60))
print(report)

model = gn.ForwardModel.for_scene(robot, hidden=64).bind(robot)
print(gn.fit(model, train, steps=500, progress=False))
errors = gn.evaluate_errors(model, test, horizons=(20, 60), keep=1)
print(errors)
plot_joints(test["state"][0], {"predicted": errors.rollouts[0]}, robot, picture)
