"""Acrobot: two links, a motor between them. 10 ms, one suite physics step (RK4)."""

from torchrl_gn.scenes.systems.system import System, suite_model

SYSTEM = System("acrobot", lambda: suite_model("acrobot"), timestep=0.01)
