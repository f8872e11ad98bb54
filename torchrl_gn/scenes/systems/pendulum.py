"""Pendulum: one hinge with a torque motor. 20 ms, one suite physics step.

Variants: length of the massless pole, and mass at its end, whose radius stays.
"""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np

from torchrl_gn.scenes.systems.resize import resize_capsule
from torchrl_gn.scenes.systems.system import ParameterRange, System, suite_model

_RANGES = {"length": ParameterRange(0.2, 1.0), "mass": ParameterRange(0.5, 3.0)}


def _vary(spec: mujoco.MjSpec, parameters: Mapping[str, float]) -> None:
    ball = spec.geom("mass")
    ball.pos = parameters["length"] * np.asarray(ball.pos)
    ball.mass *= parameters["mass"]
    resize_capsule(spec.geom("pole"), parameters["length"], 1.0)


SYSTEM = System("pendulum", lambda: suite_model("pendulum"), timestep=0.02, ranges=_RANGES, vary=_vary)
