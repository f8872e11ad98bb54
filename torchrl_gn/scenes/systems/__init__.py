"""The paper's seven systems: one file for each that has variants; those without stand here."""

from __future__ import annotations

import re
from functools import partial

from torchrl_gn.scenes.systems import cartpole, cheetah, jaco, pendulum
from torchrl_gn.scenes.systems.swimmer import swimmer
from torchrl_gn.scenes.systems.system import ParameterRange, System, suite_model

__all__ = ["SYSTEMS", "ParameterRange", "System", "find_system", "swimmer"]

_BY_NAME: dict[str, System] = {
    system.name: system
    for system in (
        pendulum.SYSTEM,
        cartpole.SYSTEM,
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
"""Names of the paper's seven systems; ``swimmerN`` exists for every N from 3."""


def find_system(name: str) -> System | None:
    """The system of that name, or None; ValueError for ``swimmerN`` with ``N < 3``."""
    links = re.fullmatch(r"swimmer(\d+)", name)
    return swimmer(int(links[1])) if links else _BY_NAME.get(name)
