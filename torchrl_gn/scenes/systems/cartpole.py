"""Cartpole: a cart on a rail, limited to 1.8 m either side, with a pole. 10 ms, one suite physics step (RK4).

Variants: mass of the cart, at its size; length and thickness of the pole, whose mass follows its volume.
"""

from __future__ import annotations

from collections.abc import Mapping

import mujoco

from torchrl_gn.scenes.systems.resize import resize_capsule
from torchrl_gn.scenes.systems.system import ParameterRange, System, suite_model

_RANGES = {
    "cart_mass": ParameterRange(0.2, 2.0),
    "pole_length": ParameterRange(0.3, 1.0),
    "pole_thickness": ParameterRange(0.4, 2.2),
}


def _vary(spec: mujoco.MjSpec, parameters: Mapping[str, float]) -> None:
    spec.geom("cart").mass *= parameters["cart_mass"]
    resize_capsule(spec.geom("pole_1"), parameters["pole_length"], parameters["pole_thickness"])


SYSTEM = System("cartpole", lambda: suite_model("cartpole"), timestep=0.01, ranges=_RANGES, vary=_vary)
