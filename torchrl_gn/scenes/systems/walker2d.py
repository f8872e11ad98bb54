"""Walker2d: the planar walker of the suite. 2.5 ms, one suite physics step (the suite itself acts every 25 ms)."""

from torchrl_gn.scenes.systems.system import System, suite_model

SYSTEM = System("walker2d", lambda: suite_model("walker"), timestep=0.0025)
