"""URDF files: elements, paths of meshes, motors for joints, and checkpoints."""

from __future__ import annotations

import json

import mujoco
import numpy as np
import pytest

from torchrl_gn.data import Simulator
from torchrl_gn.scenes import SceneError, load_scene, scene_from_description
from torchrl_gn.scenes.urdf import is_urdf

CORNERS = "v 0 0 0\nv 1 0 0\nv 0 .7 0\nv 0 0 .3\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
INERTIA = '<inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>'


def link(name, shape=""):
    return f'<link name="{name}">{INERTIA}{shape}</link>'


def joint(name, kind, parent, child, more=""):
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="0 0 .2"/><axis xyz="0 1 0"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{more}</joint>'


def limit(effort, lower=-1.0, upper=1.0):
    return f'<limit lower="{lower}" upper="{upper}" effort="{effort}" velocity="1"/>'


def robot(*parts, extension=""):
    return f'<?xml version="1.0"?>\n<robot name="arm">{extension}{"".join(parts)}</robot>'


GRIPPER = robot(
    *(link(name) for name in ("base", "arm", "wrist", "left", "right", "tool")),
    joint("shoulder", "continuous", "base", "arm", limit(4)),
    joint("turn", "spherical", "arm", "wrist"),
    joint("grip", "prismatic", "wrist", "left", limit(20, 0, 0.1)),
    joint("other", "prismatic", "wrist", "right", limit(20, 0, 0.1) + '<mimic joint="grip" multiplier="-1"/>'),
    joint("flange", "fixed", "right", "tool"),
)
NO_MIMIC = not load_scene(GRIPPER).model.neq  # MuJoCo may be too old to read it


def meshes(name, extension=""):
    picture = '<visual><geometry><mesh filename="package://none/picture.dae"/></geometry></visual>'
    shape = f'<collision><geometry><mesh filename="{name}"/></geometry></collision>{picture}'
    lift = joint("lift", "revolute", "base", "arm", limit(5) + '<dynamics damping=".2" friction=".3"/>')
    return robot(link("base"), link("arm", shape), lift, extension=extension)


@pytest.mark.parametrize("form", ["../{}/arm.obj", "package://my_arm/{}/arm.obj"])
@pytest.mark.parametrize("meshdir", ["", "../meshes"])
def test_meshes_of_equal_names_in_different_folders_are_not_one(workspace, form, meshdir):
    (workspace.parent / "tools").mkdir()
    (workspace.parent / "tools/arm.obj").write_text(CORNERS.replace(".3", "3"))

    def shaped(name, folder):
        shape = f'<collision><geometry><mesh filename="{form.format(folder)}"/></geometry></collision>'
        return link(name, shape)

    extension = f'<mujoco><compiler meshdir="{meshdir}"/></mujoco>'
    links = shaped("a", "meshes"), shaped("b", "tools"), shaped("c", "tools")
    joints = (joint(name, "revolute", "base", name, limit(5)) for name in "abc")
    (workspace / "arm.urdf").write_text(robot(link("base"), *links, *joints, extension=extension))
    scene = load_scene(workspace / "arm.urdf")
    for each in scene, scene_from_description(json.loads(json.dumps(scene.description()))):
        spread = [np.ptp(each.model.geom_aabb[geom, 3:]) for geom in range(3)]
        assert spread[0] < 0.5 * spread[1] and spread[1] == spread[2] and each.model.nmesh == 2


@pytest.fixture
def workspace(tmp_path):
    """Folder ``urdf`` of a package ``my_arm`` with a mesh."""
    for folder in ("urdf", "meshes"):
        (tmp_path / "my_arm" / folder).mkdir(parents=True)
    (tmp_path / "my_arm/meshes/arm.obj").write_text(CORNERS)
    return tmp_path / "my_arm/urdf"


def rebuilt(scene, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    return scene_from_description(json.loads(json.dumps(scene.description())))


@pytest.mark.parametrize(
    ("mesh", "extension"),
    [
        ("../meshes/arm.obj", ""),
        ("package://my_arm/meshes/arm.obj", ""),
        ("package://other_name/meshes/arm.obj", ""),  # a checkout in a folder of another name
        ("model://my_arm/meshes/arm.obj", ""),
        ("file://{folder}/../meshes/arm.obj", ""),
        ("package://my_arm/meshes/arm.obj", '<mujoco><compiler meshdir="../meshes"/></mujoco>'),
        ("package://my_arm/meshes/arm.obj", '<mujoco><compiler meshdir="../meshes" strippath="true"/></mujoco>'),
        ("arm.obj", '<mujoco><compiler meshdir="../meshes"/></mujoco>'),
        ("..\\meshes\\arm.obj", ""),  # MuJoCo takes backslashes for slashes
        ("package://my_arm\\meshes\\arm.obj", ""),
        ("arm.obj", '<mujoco><compiler meshdir="..\\meshes"/></mujoco>'),
    ],
)
def test_meshes_are_found_and_stored(workspace, monkeypatch, tmp_path, mesh, extension):
    file = workspace / "arm.urdf"
    file.write_text(meshes(mesh.format(folder=workspace), extension))
    scene = load_scene(file)
    (workspace.parent / "meshes/arm.obj").unlink()
    again = rebuilt(scene, monkeypatch, tmp_path)
    assert scene.model.nmesh == again.model.nmesh == 1 and scene.fingerprint() == again.fingerprint()
    model = scene.model
    assert model.dof_damping[0] == 0.2 and model.dof_frictionloss[0] == 0.3
    np.testing.assert_array_equal(model.jnt_range[0], [-1, 1])


def test_a_missing_mesh_is_named(workspace):
    (workspace / "arm.urdf").write_text(meshes("package://my_arm/meshes/none.obj"))
    with pytest.raises(SceneError, match="none.obj"):
        load_scene(workspace / "arm.urdf")


@pytest.mark.parametrize("name", ["arm.URDF", "arm.xml", "arm.robot", "arm.XML"])
def test_urdf_is_known_by_its_content(workspace, name):
    (workspace / name).write_text("<!-- <mujoco> -->\n" + meshes("package://my_arm/meshes/arm.obj"))
    assert load_scene(workspace / name).model.nmesh == 1


@pytest.mark.parametrize("name", ["arm.mjcf", "arm.XML", "arm.MJCF"])
def test_mjcf_of_any_suffix(workspace, monkeypatch, tmp_path, name):
    (workspace / "arm.xml").write_text(
        "<mujocoinclude><body><joint/><geom type='mesh' mesh='arm'/></body></mujocoinclude>"
    )
    mesh = "<compiler meshdir='../meshes'/><asset><mesh name='arm' file='arm.obj'/></asset>"
    (workspace / name).write_text(f"<mujoco>{mesh}<worldbody><include file='arm.xml'/></worldbody></mujoco>")
    scene = load_scene(workspace / name)
    assert scene.name == "arm" and scene.model.nmesh == 1
    assert rebuilt(scene, monkeypatch, tmp_path).fingerprint() == scene.fingerprint()


def test_what_is_urdf():
    assert is_urdf(GRIPPER) and is_urdf("<!-- an <a> --><robot>")
    assert not is_urdf("<mujoco><!-- <robot> --></mujoco>") and not is_urdf("") and not is_urdf("<robots/>")


def test_a_urdf_that_is_not_there():
    with pytest.raises(FileNotFoundError, match=r"my_robot\.urdf"):
        load_scene("my_robot.urdf")


@pytest.mark.skipif(NO_MIMIC, reason="MuJoCo reads no mimic")
def test_motors(monkeypatch, tmp_path):
    scene = load_scene(GRIPPER, motors=True, action_bounds=(-3, 3))
    assert scene.actuator_names == ("shoulder", "turn_x", "turn_y", "turn_z", "grip")
    np.testing.assert_array_equal(scene.action_high, [4, 3, 3, 3, 20])
    np.testing.assert_array_equal(scene.action_low, [-4, -3, -3, -3, -20])
    again = rebuilt(scene, monkeypatch, tmp_path)
    assert again.actuator_names == scene.actuator_names and again.fingerprint() == scene.fingerprint()
    # The torque of each is what its control says, along its own coordinate.
    data = mujoco.MjData(scene.model)
    data.ctrl[:] = [1, 2, 3, 0.5, 6]
    mujoco.mj_forward(scene.model, data)
    np.testing.assert_allclose(data.qfrc_actuator, [1, 2, 3, 0.5, 6, 0])
    assert load_scene(GRIPPER, motors=True).unbounded == ("turn_x", "turn_y", "turn_z")


def test_motors_of_a_spec_leave_it_as_it_is():
    spec = mujoco.MjSpec.from_string("<mujoco><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>")
    scene = load_scene(spec, motors=True, action_bounds=(-1, 1))
    assert scene.actuator_names == ("joint0",) and not spec.actuators and not spec.joints[0].name
    assert Simulator(scene).scene.num_actions == 1


@pytest.mark.parametrize(
    ("source", "error", "message"),
    [
        ("pendulum", ValueError, "'pendulum' has motors of its own"),
        ("<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>", SceneError, "no joint"),
        (
            "<mujoco><worldbody><body><joint name='a'/><geom size='.1'/></body></worldbody>"
            "<actuator><motor joint='a'/></actuator></mujoco>",
            SceneError,
            "without actuators",
        ),
    ],
)
def test_models_that_get_no_motors(source, error, message):
    with pytest.raises(error, match=message):
        load_scene(source, motors=True)


def test_xacro_that_is_not_written_out_is_refused():
    text = """<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"><!-- <xacro:arm/> --><link name="base"/>
    <link name="arm"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    </link><joint name="j" type="continuous"><parent link="base"/><child link="arm"/></joint></robot>"""
    assert load_scene(text).num_nodes == 2
    with pytest.raises(SceneError, match="<xacro:gripper>.*xacro FILE"):
        load_scene(text.replace("</robot>", '<xacro:gripper parent="arm"/></robot>'))
