"""What defines one of the library's own systems."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mujoco


@dataclass(frozen=True)
class System:
    """A system of the paper (SM "Description of the simulated environments").

    Attributes:
        name: what :func:`~torchrl_gn.scenes.load_scene` calls it.
        build: makes the MJCF model.
        timestep: control step, seconds.
        settle_steps: physics steps without control after a reset.
    """

    name: str
    build: Callable[[], mujoco.MjSpec]
    timestep: float
    settle_steps: int = 0


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
        raise ModuleNotFoundError("The paper's systems need the model files of dm_control: pip install dm-control.")
    return str(Path(package.submodule_search_locations[0], path))


def suite_model(domain: str) -> mujoco.MjSpec:
    """MJCF model of a domain of the DeepMind Control Suite."""
    return mujoco.MjSpec.from_file(model_file(f"suite/{domain}.xml"))
