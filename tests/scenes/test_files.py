"""Files of models: of installed packages, and visual meshes that are missing."""

from __future__ import annotations

import json
import sys
import warnings

import mujoco
import numpy as np
import pytest

from torchrl_gn.scenes import MissingMeshWarning, SceneError, load_scene, scene_from_description

CORNERS = "v 0 0 0\nv 1 0 0\nv 0 .7 0\nv 0 0 .3\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
SKIN = "<geom type='mesh' mesh='skin' contype='0' conaffinity='0'/>"
MODEL = (
    "<mujoco><compiler meshdir='meshes'/><asset><mesh name='skin' file='skin.obj'/></asset><worldbody>"
    "<body><joint/>{inertial}<geom size='.1'/>{visual}</body></worldbody></mujoco>"
)
INERTIAL = "<inertial pos='0 0 0' mass='1' diaginertia='1 1 1'/>"


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Folder of an importable package."""
    folder = tmp_path / "robots_of_mine"
    (folder / "meshes").mkdir(parents=True)
    (folder / "__init__.py").touch()
    (folder / "arm.xml").write_text(MODEL.format(inertial=INERTIAL, visual=SKIN))
    monkeypatch.syspath_prepend(str(tmp_path))
    yield folder
    sys.modules.pop("robots_of_mine", None)


def test_a_file_of_a_package(package):
    (package / "meshes/skin.obj").write_text(CORNERS)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load_scene("package://robots_of_mine/arm.xml")
        again = scene_from_description(json.loads(json.dumps(scene.description())))
    assert scene.name == "arm" and scene.model.nmesh == again.model.nmesh == 1
    np.testing.assert_array_equal(scene.model.mesh_vert, again.model.mesh_vert)


@pytest.mark.parametrize(
    ("source", "error", "message"),
    [
        ("package://robots_of_mine/leg.xml", FileNotFoundError, "package 'robots_of_mine' has no file 'leg.xml'"),
        ("package://no_such_package/a.xml", FileNotFoundError, "'no_such_package', which is not installed"),
        ("package://robots_of_mine", ValueError, "must be package://NAME/PATH"),
    ],
)
def test_what_a_package_has_not_got(package, source, error, message):
    with pytest.raises(error, match=message):
        load_scene(source)


def test_missing_visual_meshes_are_left_out(package):
    (package / "meshes/skin.obj").write_text(CORNERS)
    whole = load_scene(package / "arm.xml")
    (package / "meshes/skin.obj").unlink()
    with pytest.warns(MissingMeshWarning, match=r"1 visual meshes of .*arm.xml are missing \(skin\)"):
        scene = load_scene(package / "arm.xml")
    assert scene.model.nmesh == 0 and scene.model.ngeom == whole.model.ngeom - 1
    assert scene.fingerprint() == whole.fingerprint()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert scene_from_description(scene.description()).fingerprint() == scene.fingerprint()


@pytest.mark.parametrize(
    ("inertial", "visual"),
    [
        ("", SKIN),  # the mesh gives mass
        (INERTIAL, SKIN.replace("contype='0'", "contype='1'")),
        (INERTIAL, SKIN + SKIN.replace("conaffinity='0'", "conaffinity='2'")),
    ],
)
def test_a_missing_mesh_that_matters_is_refused(package, inertial, visual):
    (package / "arm.xml").write_text(MODEL.format(inertial=inertial, visual=visual))
    with pytest.raises(SceneError, match="skin.obj"):
        load_scene(package / "arm.xml")


BACKSLASHED = {
    "file": "<asset><mesh name='m' file='parts\\m.obj'/></asset><worldbody>{}</worldbody>",
    "folder": "<compiler meshdir='parts\\deep'/><asset><mesh file='..\\m.obj'/></asset><worldbody>{}</worldbody>",
    "include": "<asset><mesh file='parts/m.obj'/></asset><worldbody><include file='parts\\body.xml'/></worldbody>",
    "attached": "<asset><model name='arm' file='parts\\arm.xml'/></asset>"
    "<worldbody><attach model='arm' body='b' prefix='x'/></worldbody>",
}


@pytest.mark.parametrize("kind", BACKSLASHED)
@pytest.mark.parametrize("before", ["", "<!DOCTYPE mujoco>\n"])
def test_backslashes_in_paths_are_slashes(tmp_path, monkeypatch, kind, before):
    """As of exporters for Windows; MuJoCo reads them everywhere."""
    if kind == "attached" and not hasattr(mujoco.mjtEnableBit, "mjENBL_SLEEP"):
        pytest.skip("stored scenes with attached models need MuJoCo 3.4")
    body = "<body name='b'><joint/><geom type='mesh' mesh='m' contype='0' conaffinity='0'/></body>"
    robot = f"<mujoco><asset><mesh file='m.obj'/></asset><worldbody>{body}</worldbody></mujoco>"
    (tmp_path / "parts/deep").mkdir(parents=True)
    (tmp_path / "parts/m.obj").write_text(CORNERS)
    (tmp_path / "parts/body.xml").write_text(f"<mujocoinclude>{body}</mujocoinclude>")
    (tmp_path / "parts/arm.xml").write_text(robot)
    (tmp_path / "robot.xml").write_text(f"{before}<mujoco>{BACKSLASHED[kind].format(body)}</mujoco>")
    with warnings.catch_warnings():
        warnings.simplefilter("error", MissingMeshWarning)
        scene = load_scene(tmp_path / "robot.xml")
    (tmp_path / "parts/m.obj").unlink()
    monkeypatch.chdir("/")
    again = scene_from_description(json.loads(json.dumps(scene.description())))
    assert again.fingerprint() == scene.fingerprint() and again.model.nmesh == 1


URDF = """<robot name="r"><link name="base"><inertial><mass value="1"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="arm"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><geometry><mesh filename="parts/m.obj"/></geometry></collision></link>
  <joint name="j" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/></joint></robot>"""


def test_meshes_of_an_attached_urdf_are_stored(tmp_path, monkeypatch):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts/m.obj").write_text(CORNERS)
    (tmp_path / "arm.urdf").write_text(URDF)
    (tmp_path / "robot.xml").write_text(
        "<mujoco><asset><model name='r' file='arm.urdf'/></asset><worldbody><attach model='r' body='arm' prefix='x'/>"
        "</worldbody></mujoco>"
    )
    try:
        mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    except ValueError:  # MuJoCo 3.3 looks for the mesh beside the URDF file
        pytest.skip("this MuJoCo cannot read it")
    scene = load_scene(tmp_path / "robot.xml")
    (tmp_path / "parts/m.obj").unlink()
    monkeypatch.chdir("/")
    again = scene_from_description(json.loads(json.dumps(scene.description())))
    assert again.fingerprint() == scene.fingerprint() and again.model.nmesh == 1
