"""Cartpole: a cart on a rail, limited to 1.8 m either side, with a pole. 10 ms, one suite physics step (RK4)."""

from torchrl_gn.scenes.systems.system import System, suite_model

SYSTEM = System("cartpole", lambda: suite_model("cartpole"), timestep=0.01)
