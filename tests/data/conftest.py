"""Scenes that the data tests share."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase

from torchrl_gn.data import collect, dataset
from torchrl_gn.scenes import Scene, load_scene


def repelled_hinge(threshold: float, timestep: float = 1e-7) -> Scene:
    """A hinge pushed away from zero, unstable (acceleration above 1e10) beyond an angle."""
    return load_scene(
        f"""<mujoco model="repelled">
          <option timestep="{timestep}" gravity="0 0 0"/>
          <worldbody><body>
            <joint name="a" axis="0 1 0" armature="1" stiffness="{-1e10 / threshold}"/>
            <geom size=".01" mass="1e-9"/>
          </body></worldbody>
          <actuator><motor joint="a" ctrllimited="true" ctrlrange="-1 1"/></actuator>
        </mujoco>""",
        timestep=timestep,
    )


def equal(first: TensorDictBase, second: TensorDictBase) -> bool:
    assert set(first.keys(True, True)) == set(second.keys(True, True))
    return all(torch.equal(first[key], second[key]) for key in first.keys(True, True))


def contents(folder: Path) -> dict[str, bytes]:
    """Files of a folder by their paths in it."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def small_chunks(monkeypatch) -> None:
    """Chunks of four trajectories."""
    for module in (collect, dataset):
        monkeypatch.setattr(module, "CHUNK", 4)


@pytest.fixture(scope="session")
def swimmer() -> Scene:
    return load_scene("swimmer6")


@pytest.fixture(scope="session")
def pendulum() -> Scene:
    return load_scene("pendulum")
