"""Swimmer: a chain of links in a viscous plane. 20 ms, ten suite physics steps of 2 ms.

The suite's file holds the head; the other links are added here as
``dm_control.suite.swimmer`` adds them (the suite itself acts every 30 ms).
"""

from __future__ import annotations

from functools import partial

import mujoco

from torchrl_gn.scenes.systems.system import System, suite_model


def swimmer(links: int) -> System:
    """Swimmer with any number of links.

    Args:
        links: number of links, head included, at least 3.

    Raises:
        ValueError: if there are fewer than 3 links.
    """
    if links < 3:
        raise ValueError(f"A swimmer has at least 3 links, got {links}.")
    return System(f"swimmer{links}", partial(_build, links), timestep=0.02)


def _build(links: int) -> mujoco.MjSpec:
    spec = suite_model("swimmer")
    default = {name: spec.find_default(name) for name in ("swimmer", "inertial", "visual")}
    parent = spec.body("head")
    limit = 360.0 / links  # degrees, as the suite
    for i in range(links - 1):
        parent = parent.add_body(name=f"segment_{i}", pos=[0, 0.1, 0])
        parent.add_geom(default["visual"], name=f"visual_{i}")
        parent.add_geom(default["inertial"], name=f"inertial_{i}")
        parent.add_site(default["swimmer"], name=f"site_{i}")
        parent.add_joint(default["swimmer"], name=f"joint_{i}", range=[-limit, limit])
        spec.add_actuator(
            spec.default,
            name=f"motor_{i}",
            target=f"joint_{i}",
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
        )
    return spec
