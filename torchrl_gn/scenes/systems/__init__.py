"""The paper's seven systems; larger systems with variants have their own modules."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import partial

import mujoco
import numpy as np

from torchrl_gn.scenes.systems import cheetah, jaco
from torchrl_gn.scenes.systems.swimmer import swimmer
from torchrl_gn.scenes.systems.system import ParameterRange, System, resize_capsule, suite_model

__all__ = ["SYSTEMS", "ParameterRange", "System", "find_system", "swimmer"]


def _vary_pendulum(spec: mujoco.MjSpec, parameters: Mapping[str, float]) -> None:
    ball = spec.geom("mass")
    ball.pos = parameters["length"] * np.asarray(ball.pos)
    ball.mass *= parameters["mass"]
    resize_capsule(spec.geom("pole"), parameters["length"], 1.0)


def _vary_cartpole(spec: mujoco.MjSpec, parameters: Mapping[str, float]) -> None:
    spec.geom("cart").mass *= parameters["cart_mass"]
    resize_capsule(spec.geom("pole_1"), parameters["pole_length"], parameters["pole_thickness"])


# One hinge with a torque motor, one suite physics step. Variants: length of the massless pole, and mass of the ball at
# its end, at fixed radius.
_PENDULUM = {"length": ParameterRange(0.2, 1.0), "mass": ParameterRange(0.5, 3.0)}
# A cart on a rail, limited to 1.8 m either side, with a pole; one suite physics step (RK4). Variants: mass of the cart,
# at fixed size; length and thickness of the pole, whose mass follows its volume.
_CARTPOLE = {
    "cart_mass": ParameterRange(0.2, 2.0),
    "pole_length": ParameterRange(0.3, 1.0),
    "pole_thickness": ParameterRange(0.4, 2.2),
}
_BY_NAME: dict[str, System] = {
    system.name: system
    for system in (
        System("pendulum", partial(suite_model, "pendulum"), timestep=0.02, ranges=_PENDULUM, vary=_vary_pendulum),
        System("cartpole", partial(suite_model, "cartpole"), timestep=0.01, ranges=_CARTPOLE, vary=_vary_cartpole),
        # Two links with a motor between them, one suite physics step (RK4).
        System("acrobot", partial(suite_model, "acrobot"), timestep=0.01),
        swimmer(6),
        cheetah.SYSTEM,
        # Planar, one suite physics step; the suite itself acts every 25 ms.
        System("walker2d", partial(suite_model, "walker"), timestep=0.0025),
        jaco.SYSTEM,
    )
}

SYSTEMS: tuple[str, ...] = tuple(_BY_NAME)
"""Names of the paper's seven systems; ``swimmerN`` exists for every N from 3 to 500."""


def find_system(name: str) -> System | None:
    """Return the system of that name, or None; ValueError for ``swimmerN`` with N outside of 3 to 500."""
    links = re.fullmatch(r"swimmer(\d{1,9})", name)
    return swimmer(int(links[1])) if links else _BY_NAME.get(name)
