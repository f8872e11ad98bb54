"""Pendulum: one hinge with a torque motor. 20 ms, one suite physics step of 20 ms."""

from torchrl_gn.scenes.systems.system import System, suite_model

SYSTEM = System("pendulum", lambda: suite_model("pendulum"), timestep=0.02)
