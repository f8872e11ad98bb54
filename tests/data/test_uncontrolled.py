"""Scenes that no action moves are named, and only these."""

from __future__ import annotations

import warnings

import pytest

from torchrl_gn.data import UncontrolledSceneWarning, UnstableSimulationError, collect_trajectories, create_dataset
from torchrl_gn.scenes import load_scene

ARM = """
<mujoco model="arm"><option><flag contact="disable"/></option><worldbody>
  <body name="target" mocap="true" pos=".5 0 0"/>
  <body name="upper"><joint name="shoulder" axis="0 1 0" {joint}/>
    <geom type="capsule" fromto="0 0 0 .5 0 0" size=".03"/>
    <body name="hand" pos=".5 0 0"><geom size=".04"/><site name="grip"/></body></body>
  </worldbody><equality>{equality}</equality><actuator>{actuator}</actuator></mujoco>"""
MOTOR = '<motor name="m" joint="shoulder" ctrlrange="-1 1"/>'


def arm(joint: str = "", equality: str = "", actuator: str = MOTOR):
    return load_scene(ARM.format(joint=joint, equality=equality, actuator=actuator))


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        (arm(actuator=""), r"'arm' show no control: it has no actions. .* \['shoulder'\]"),
        (arm(actuator=MOTOR.replace("/>", ' gear="0"/>')), r"no action moves anything. .* \['m'\]"),
        (arm(joint='damping="1e12"'), r"no action moves anything. .* \['m'\]"),
        (arm(equality='<weld body1="target" body2="hand"/>'), r"\['hand'\] are held to mocap bodies"),
        (arm(equality='<connect body1="upper" body2="target" anchor="0 0 0"/>'), r"\['upper'\] are held to mocap"),
    ],
)
def test_a_scene_that_no_action_moves_is_named_where_it_is_collected(scene, message: str) -> None:
    with pytest.warns(UncontrolledSceneWarning, match=message) as caught:
        collect_trajectories(scene, 2, 3)
    assert {warning.filename for warning in caught} == {__file__}


def test_a_data_set_warns_once_when_it_is_collected(tmp_path) -> None:
    scene = arm(actuator="")
    with pytest.warns(UncontrolledSceneWarning) as caught:
        create_dataset(tmp_path / "data", scene, 2, 2, 2, steps=3)
    assert len(caught) == 1 and caught[0].filename == __file__
    with warnings.catch_warnings(action="error"):
        create_dataset(tmp_path / "data", scene, 2, 2, 2, steps=3)


@pytest.mark.parametrize(
    "scene",
    [
        arm(),
        arm(equality='<weld body1="target" body2="hand" active="false"/>'),
        load_scene('<mujoco><worldbody><body pos="0 0 1"><freejoint/><geom size=".1"/></body></worldbody></mujoco>'),
    ],
    ids=["motor", "weld that is off", "free bodies alone"],
)
def test_scenes_that_move_and_free_bodies_are_quiet(scene) -> None:
    with warnings.catch_warnings(action="error"):
        collect_trajectories(scene, 2, 3)


def test_actions_that_blow_up_are_not_taken_for_idle() -> None:
    with warnings.catch_warnings(action="error"), pytest.raises(UnstableSimulationError):
        collect_trajectories(arm(actuator=MOTOR.replace("/>", ' gear="1e14"/>')), 2, 3)
