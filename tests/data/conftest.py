"""Scenes that the data tests share."""

from __future__ import annotations

import pytest

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


@pytest.fixture(scope="session")
def swimmer() -> Scene:
    return load_scene("swimmer6")


@pytest.fixture(scope="session")
def pendulum() -> Scene:
    return load_scene("pendulum")
