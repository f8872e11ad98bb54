"""The systems of the paper, one file each."""

from __future__ import annotations

import re

from torchrl_gn.scenes.systems import acrobot, cartpole, cheetah, jaco, pendulum, walker2d
from torchrl_gn.scenes.systems.swimmer import swimmer
from torchrl_gn.scenes.systems.system import ParameterRange, System

__all__ = ["SYSTEMS", "ParameterRange", "System", "find_system", "swimmer"]

_BY_NAME: dict[str, System] = {
    system.name: system
    for system in (
        pendulum.SYSTEM,
        cartpole.SYSTEM,
        acrobot.SYSTEM,
        swimmer(6),
        cheetah.SYSTEM,
        walker2d.SYSTEM,
        jaco.SYSTEM,
    )
}

SYSTEMS: tuple[str, ...] = tuple(_BY_NAME)
"""Names of the paper's seven systems; ``swimmerN`` exists for every N from 3."""


def find_system(name: str) -> System | None:
    """The system of that name, or None.

    Raises:
        ValueError: for ``swimmerN`` with ``N < 3``.
    """
    links = re.fullmatch(r"swimmer(\d+)", name)
    return swimmer(int(links[1])) if links else _BY_NAME.get(name)
