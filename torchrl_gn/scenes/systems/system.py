"""What defines one of the library's own systems."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import mujoco

# labmaze, which dm-control requires and nothing here uses, has no wheels for Python 3.13 and newer.
INSTALL_SUITE = 'pip install "torchrl_gn[suite]"'
if sys.version_info >= (3, 13):
    INSTALL_SUITE += " && pip install --no-deps dm-control"


@dataclass(frozen=True)
class ParameterRange:
    """Between which values random variants of a system have a parameter.

    Attributes:
        low: smallest value: a factor of the standard system's, or an angle in radians.
        high: largest value.
        standard: value in the standard system: 1 for factors, 0 for angles.
    """

    low: float
    high: float
    standard: float = 1.0

    @property
    def is_angle(self) -> bool:
        """Whether the parameter is added, in radians, and no factor."""
        return self.standard == 0


@dataclass(frozen=True)
class System:
    """A system of the paper (SM "Description of the simulated environments").

    Attributes:
        name: what :func:`~torchrl_gn.scenes.load_scene` calls it.
        build: makes the MJCF model.
        timestep: control step, seconds.
        settle_steps: physics steps without control after a reset.
        ranges: by name, the parameters that random variants differ in; empty if there are none.
        vary: changes a freshly built model to given values of all parameters.
    """

    name: str
    build: Callable[[], mujoco.MjSpec]
    timestep: float
    settle_steps: int = 0
    ranges: Mapping[str, ParameterRange] = field(default_factory=dict)
    vary: Callable[[mujoco.MjSpec, Mapping[str, float]], None] | None = None


def model_file(path: str) -> str:
    """Path of a model file that dm_control ships.

    The files are read without importing dm_control, whose import would choose an
    OpenGL backend and complain without a display.

    Args:
        path: path inside the ``dm_control`` package, for example ``"suite/cheetah.xml"``.

    Raises:
        ModuleNotFoundError: if dm_control is not installed.
    """
    package = importlib.util.find_spec("dm_control")
    if package is None or not package.submodule_search_locations:
        raise ModuleNotFoundError(f"The paper's systems need the model files of dm_control: {INSTALL_SUITE}.")
    return str(Path(package.submodule_search_locations[0], path))


def suite_model(domain: str) -> mujoco.MjSpec:
    """MJCF model of a domain of the DeepMind Control Suite."""
    return mujoco.MjSpec.from_file(model_file(f"suite/{domain}.xml"))
