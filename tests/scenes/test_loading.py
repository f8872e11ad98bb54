"""Loading by name, file, text and description, and refusals."""

from __future__ import annotations

import json
import re
import shutil
import zipfile
from pathlib import Path

import mujoco
import numpy as np
import pytest

from torchrl_gn.data.simulate import Simulator
from torchrl_gn.data.start_states import sample_start_states
from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.scenes import (
    SYSTEMS,
    MissingMeshWarning,
    Scene,
    SceneChangedWarning,
    SceneError,
    UnsupportedSceneError,
    load_scene,
    scene_from_description,
)
from torchrl_gn.scenes.systems.system import model_file

from .. import zoo

GOOD, MOTOR = zoo.mjcf("two_links"), '<motor name="m" joint="a" ctrlrange="-1 2"/>'


def test_text_file_and_spec_give_the_same_scene(tmp_path):
    path = tmp_path / "mine.xml"
    path.write_text(GOOD)
    scenes = [load_scene(source) for source in (GOOD, path, str(path), mujoco.MjSpec.from_string(GOOD))]
    assert [scene.name for scene in scenes] == ["two_links", "mine", "mine", "two_links"]
    assert len({scene.fingerprint() for scene in scenes}) == 1
    assert (scenes[0].action_low[0], scenes[0].action_high[0]) == (-1, 2)
    assert load_scene(path, name="other").name == "other"


def test_text_may_begin_with_a_byte_order_mark():
    scene = load_scene("\ufeff" + GOOD)
    assert scene.joint_names == load_scene(GOOD).joint_names
    assert scene_from_description(scene.description()).fingerprint() == scene.fingerprint()


def test_loading_leaves_a_spec_as_it_was():
    spec = mujoco.MjSpec.from_string(GOOD)
    before = spec.to_xml()
    load_scene(spec)
    assert spec.to_xml() == before


@pytest.mark.parametrize(
    ("actuators", "rest", "named"),
    [
        pytest.param(
            '<motor name="late" joint="a" ctrlrange="-1 1" delay=".01" nsample="9" interp="cubic"/>',
            "",
            ["'late'", "delay"],
            marks=pytest.mark.skipif(not hasattr(mujoco.MjModel, "actuator_history"), reason="needs MuJoCo 3.5"),
        ),
    ],
)
def test_refusals_name_the_element(actuators, rest, named):
    with pytest.raises(UnsupportedSceneError) as error:
        zoo.load("two_links", (MOTOR, actuators), ("<actuator>", rest + "<actuator>"))
    for text in named:
        assert text in str(error.value)


@pytest.mark.parametrize("domain", ["hopper", "humanoid", "ball_in_cup", "reacher", "finger"])
def test_other_suite_domains_work(domain):
    scene = load_scene(model_file(f"suite/{domain}.xml"))
    assert scene.static.edge_names == load_scene("pendulum").static.edge_names
    assert scene.num_edges == 2 * scene.model.njnt
    assert scene.num_actions == scene.model.nu > 0
    assert scene.timestep == 0.02


def test_humanoid_has_one_edge_type_for_its_free_joint():
    scene = load_scene(model_file("suite/humanoid.xml"))
    free = scene.static.edges[:, scene.static.edge_names.index("jnt_type[FREE]")]
    np.testing.assert_array_equal(np.flatnonzero(free), [0, 1])
    np.testing.assert_array_equal(scene.translation_invariant, [True, True, False])
    assert scene.movable[1:].all()


@pytest.mark.parametrize(
    ("name", "hint"),
    [("walker", "'walker2d'"), ("swimer6", "'swimmer6'"), ("Jaco", "'jaco'"), ("zzz", "pendulum, cartpole")],
)
def test_unknown_name_lists_the_names(name, hint):
    with pytest.raises(ValueError, match="Unknown scene") as error:
        load_scene(name)
    assert repr(name) in str(error.value) and hint in str(error.value)
    assert all(known in str(error.value) for known in SYSTEMS if known != "swimmer6")


def test_bad_sources():
    with pytest.raises(ValueError, match="at least 3"):
        load_scene("swimmer2")
    with pytest.raises(FileNotFoundError, match="nowhere/there.xml"):
        load_scene("nowhere/there.xml")
    with pytest.raises(SceneError, match="bdy"):
        load_scene("<mujoco><worldbody><bdy/></worldbody></mujoco>")
    with pytest.raises(SceneError, match="no joint"):
        load_scene("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    with pytest.raises(SceneError, match="cannot compile scene 'massless'.*inertia"):
        load_scene("<mujoco model='massless'><worldbody><body><joint/></body></worldbody></mujoco>")
    with pytest.raises(TypeError, match="MjModel"):
        load_scene(mujoco.MjModel.from_xml_string(GOOD))
    with pytest.raises(TypeError, match="int"):
        load_scene(3)


def test_a_model_takes_scenes_in_all_their_forms_and_nothing_else():
    model = ForwardModel.for_scene(["pendulum", mujoco.MjSpec.from_string(GOOD)], hidden=4, latent=4)
    assert model.bind(mujoco.MjSpec.from_string(GOOD)).scene.node_names == load_scene(GOOD).node_names
    for wrong, message in ((None, "got None"), (lambda: None, "call it"), ([None], "got None")):
        with pytest.raises(TypeError, match=message):
            ForwardModel.for_scene(wrong)
    with pytest.raises(TypeError, match="call it"):
        model.bind(lambda: load_scene(GOOD))
    with pytest.raises(ValueError, match="at least one scene"):
        ForwardModel.for_scene([])


@pytest.mark.parametrize(
    "wrong",
    [
        "<actuator><motor joint='nope'/></actuator>",
        "<tendon><fixed><joint joint='nope' coef='1'/></fixed></tendon>",
        "<equality><weld body1='a' body2='nope'/></equality>",
        "<sensor><jointpos joint='nope'/></sensor>",
        "<contact><exclude body1='a' body2='nope'/></contact>",
        "<contact><pair geom1='g' geom2='nope'/></contact>",
    ],
)
def test_a_name_that_does_not_exist_is_refused(wrong):
    body = "<worldbody><body name='a'><joint name='j'/><geom name='g' size='1'/></body></worldbody>"
    spec = mujoco.MjSpec.from_string(f"<mujoco>{body}{wrong}</mujoco>")
    for source in (f"<mujoco>{body}{wrong}</mujoco>", spec):
        with pytest.raises(SceneError, match="'nope'"):
            load_scene(source)


def test_broken_file_is_named_with_mujocos_message(tmp_path):
    path = tmp_path / "broken.xml"
    path.write_text("<mujoco><worldbody><bdy/></worldbody></mujoco>")
    with pytest.raises(SceneError, match=r"broken\.xml.*unrecognized element") as error:
        load_scene(path)
    assert "bdy" in str(error.value)


@pytest.mark.parametrize("timestep", [0.021, 0.0, -0.02])
def test_control_step_must_be_whole_physics_steps(timestep):
    with pytest.raises(SceneError, match="whole multiple of the physics step"):
        load_scene("swimmer6", timestep=timestep)


@pytest.mark.parametrize(
    ("physics", "control"),
    [(2, 20), (4, 20), (5, 20), (6, 18), (8, 16), (9, 18), (11, 22), (13, 13), (14, 14), (25, 25), (30, 30), (0.1, 20)],
)
def test_default_control_step_is_near_20_ms(physics, control):
    scene = load_scene(GOOD.replace("<worldbody>", f'<option timestep="{physics / 1000}"/><worldbody>', 1))
    assert scene.timestep == pytest.approx(control / 1000, rel=1e-12)


def test_control_step_can_be_chosen():
    scene = load_scene("swimmer6", timestep=0.03)
    assert scene.substeps == 15
    assert scene.static.globals_[scene.static.global_names.index("timestep")] == pytest.approx(0.03)


@pytest.mark.parametrize("source", [*SYSTEMS, "swimmer4", GOOD])
def test_description_rebuilds_the_scene(source):
    scene = load_scene(source)
    again = scene_from_description(json.loads(json.dumps(scene.description())))
    assert again.fingerprint() == scene.fingerprint()
    assert (again.name, again.timestep, again.settle_steps) == (
        scene.name,
        scene.timestep,
        scene.settle_steps,
    )
    for name in ("body_mass", "body_inertia", "geom_size", "jnt_range", "dof_damping"):
        np.testing.assert_array_equal(getattr(again.model, name), getattr(scene.model, name))


def test_description_of_a_file_needs_no_other_file(tmp_path):
    """Includes and meshes travel inside the description, with every digit."""
    (tmp_path / "meshes").mkdir()
    corners = "v 0 0 0\nv 1 0 0\nv 0 .7 0\nv 0 0 .3\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "meshes" / "corner.obj").write_text(corners)
    (tmp_path / "part.xml").write_text("<mujocoinclude><option density='1.23456789012345'/></mujocoinclude>")
    (tmp_path / "main.xml").write_text(
        "<mujoco><compiler meshdir='meshes'/><include file='part.xml'/>"
        "<asset><mesh name='c' file='corner.obj'/></asset><worldbody><body pos='.123456789012345 0 0'>"
        "<joint/><geom type='mesh' mesh='c'/></body></worldbody></mujoco>"
    )
    scene = load_scene(tmp_path / "main.xml")
    description = json.loads(json.dumps(scene.description()))
    for path in (tmp_path / "meshes" / "corner.obj", tmp_path / "part.xml", tmp_path / "main.xml"):
        path.unlink()
    again = scene_from_description(description)
    for name in ("body_mass", "body_inertia", "body_pos", "mesh_vert"):
        np.testing.assert_array_equal(getattr(again.model, name), getattr(scene.model, name))
    assert again.model.opt.density == 1.23456789012345


def test_changed_physics_warns():
    description = load_scene(GOOD).description()
    description["mjcf"] = description["mjcf"].replace('size=".01"', 'size=".011"', 1)
    with pytest.warns(SceneChangedWarning, match="two_links"):
        scene_from_description(description)


def test_spec_scene_has_no_exact_description():
    with pytest.raises(SceneError, match="MjSpec"):
        load_scene(mujoco.MjSpec.from_string(GOOD)).description()


def test_unnamed_elements_get_names():
    scene = zoo.load("two_links", ('name="second"', ""), ('name="b"', ""))
    assert scene.node_names == ("world", "first", "body2")
    assert scene.joint_names == ("a", "joint1")


def test_unnamed_elements_get_names_that_no_other_has():
    text = """<mujoco><worldbody><body><joint/><geom size=".1"/><body name="body1" pos="1 0 0"><joint name="joint0"/>
      <geom size=".1"/></body></body></worldbody>
      <actuator><motor joint="joint0"/><motor name="actuator0" joint="joint0"/></actuator></mujoco>"""
    scene = load_scene(text, action_bounds={"actuator0": (-1, 2)})
    assert scene.node_names == ("world", "body1_", "body1")
    assert scene.joint_names == ("joint0_", "joint0")
    assert scene.actuator_names == ("actuator0_", "actuator0") and scene.unbounded == ("actuator0_",)
    assert scene_from_description(scene.description()).node_names == scene.node_names
    assert load_scene(re.sub("<actuator>.*</actuator>", "", text), motors=True).actuator_names == scene.joint_names


@pytest.mark.skipif(not hasattr(mujoco.mjtEnableBit, "mjENBL_SLEEP"), reason="needs MuJoCo 3.4")
def test_sleeping_and_disabled_sensors_are_undone():
    text = GOOD.replace("<worldbody>", '<option><flag sensor="disable" sleep="enable"/></option><worldbody>')
    flags = load_scene(text).model.opt
    assert not flags.disableflags & mujoco.mjtDisableBit.mjDSBL_SENSOR
    assert not flags.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP


def test_sensors_are_left_out_and_decide_nothing():
    sensors = """<sensor><rangefinder site="eye"/><accelerometer site="eye"/><jointpos joint="a"/>
      <plugin plugin="mujoco.sensor.touch_grid" objtype="site" objname="eye"><config key="size" value="2 2"/>
        <config key="fov" value="40 40"/><config key="gamma" value="0"/><config key="nchannel" value="1"/></plugin>
    </sensor>"""
    site = GOOD.replace('<joint name="a"', '<site name="eye"/><joint name="a"', 1)
    plugin = "<extension><plugin plugin='mujoco.sensor.touch_grid'/></extension>"
    given = site.replace("<worldbody>", f"{plugin}<worldbody>").replace("</mujoco>", f"{sensors}</mujoco>")
    assert mujoco.MjModel.from_xml_string(given).nsensor == 4
    with_sensors, without = load_scene(given), load_scene(site)
    assert with_sensors.model.nsensor == without.model.nsensor == 4 * without.num_nodes
    ends = []
    for model in (with_sensors.model, without.model):
        data = mujoco.MjData(model)
        data.ctrl[:] = 1.0
        mujoco.mj_step(model, data, nstep=20)
        ends.append(np.concatenate((data.qpos, data.qvel, data.sensordata)))
    np.testing.assert_array_equal(*ends)


@pytest.mark.skipif(not hasattr(mujoco.MjModel, "actuator_history"), reason="needs MuJoCo 3.5")
def test_controls_kept_without_delay_and_late_sensors_are_no_state():
    kept = MOTOR.replace("/>", ' nsample="4" interp="linear"/>')
    sensor = '<sensor><jointpos joint="a" delay=".01" nsample="6"/></sensor></mujoco>'
    given = GOOD.replace(MOTOR, kept).replace("</mujoco>", sensor)
    by_class = GOOD.replace("<worldbody>", '<default><motor nsample="3"/></default><worldbody>')
    assert all(mujoco.MjModel.from_xml_string(text).nhistory for text in (given, by_class))
    plain = load_scene(GOOD)
    for scene in map(load_scene, (given, by_class)):
        assert scene.model.nhistory == 0 and scene.physics_size == plain.physics_size
        assert scene.fingerprint() == plain.fingerprint()
        again = scene_from_description(scene.description())
        assert again.model.nhistory == 0 and again.fingerprint() == plain.fingerprint()
        start = sample_start_states(plain, 2, 0)
        actions = np.random.default_rng(0).uniform(-1, 1, (2, 5, plain.num_actions))
        ends = [Simulator(each, 1).rollout(start, actions)["physics"] for each in (plain, scene)]
        assert ends[0].equal(ends[1]) and not ends[0][:, 0].equal(ends[0][:, 5])


WARM_STARTED = """<mujoco><option timestep="0.004" iterations="1" ls_iterations="5" tolerance="1e-4"/><worldbody>
  <geom type="plane" size="5 5 .1"/>
  <body pos="0 0 .2"><freejoint/><geom type="box" size=".3 .2 .2" mass="5"/>
    <body pos=".3 0 .1"><joint name="a" axis="0 1 0" range="-1 1" limited="true" frictionloss=".3"/>
      <geom type="capsule" fromto="0 0 0 .3 0 -.28" size=".03" mass="1"/></body></body>
  </worldbody><actuator><motor joint="a" gear="3" ctrlrange="-1 1"/></actuator></mujoco>"""


def test_few_solver_iterations_that_rest_on_warm_starts_give_the_same_motion_without():
    file, scene = mujoco.MjModel.from_xml_string(WARM_STARTED), load_scene(WARM_STARTED).model
    cold = mujoco.MjModel.from_xml_string(WARM_STARTED)
    cold.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_WARMSTART)
    data, rng, errors = mujoco.MjData(file), np.random.default_rng(0), {scene: [], cold: []}
    for step in range(100):
        for model, found in errors.items():
            again = mujoco.MjData(model)
            again.qpos[:], again.qvel[:], again.ctrl[:] = data.qpos, data.qvel, data.ctrl
            mujoco.mj_step(model, again, nstep=5)
            found.append(again.qvel.copy())
        mujoco.mj_step(file, data, nstep=5)
        for found in errors.values():
            found[-1] = np.abs(found[-1] - data.qvel).max()
        if step % 10 == 0:
            data.ctrl[:] = rng.uniform(-1, 1, 1)
    assert np.median(errors[scene]) < 1e-12 < 1e-2 < np.median(errors[cold])


@pytest.mark.slow
def test_printed_summary():
    text = str(load_scene("jaco"))
    for part in ("Scene jaco: 10 nodes, 18 edges, 9 actions", "100 ms = 50 x 2 ms", "no axis", "b_base"):
        assert part in text
    text = str(load_scene("swimmer6"))
    for part in ("along xy", "segment_4", "head - segment_0", "0: motor_0", "[-1, 1]", "7 nodes"):
        assert part in text
    assert "1 action\n" in str(load_scene("pendulum"))


def test_joints_whose_whole_turns_matter_are_printed():
    text = str(
        load_scene("""<mujoco><worldbody>
        <body><joint name="far" axis="0 0 1" range="-360 360"/><geom size=".1"/></body>
        <body pos="0 0 1"><joint name="endless" axis="0 0 1"/><geom size=".1"/></body>
        <body pos="0 0 2"><joint name="near" axis="0 0 1" range="-170 170"/><geom size=".1"/></body>
        <body pos="0 0 3"><joint name="pushed" axis="0 0 1"/><geom size=".1"/></body></worldbody>
        <actuator><position joint="far" ctrlrange="-6 6"/><position joint="endless" ctrlrange="-3 3"/>
        <position joint="near" ctrlrange="-2 2"/><motor joint="pushed" ctrlrange="-1 1"/></actuator></mujoco>""")
    )
    assert "  joints whose angles are state: far, endless" in text
    assert "angles are state" not in str(load_scene("swimmer6"))


BODY = '<body name="p" pos="0 0 1"><joint name="j"/><geom size=".1"/></body>'
INCLUDED = f"<mujocoinclude>{BODY}</mujocoinclude>"


@pytest.mark.parametrize(
    ("main", "files"),
    [
        (
            '<mujoco><!-- ---- robot ---- --><worldbody><include file="part.xml"/></worldbody></mujoco>',
            {"part.xml": "<mujocoinclude><!-- -- --->" + BODY + "</mujocoinclude>"},
        ),
        (
            '<mujoco><worldbody><include file="sub/outer.xml"/></worldbody></mujoco>',
            {"sub/outer.xml": '<mujocoinclude><include file="inner.xml"/></mujocoinclude>', "sub/inner.xml": INCLUDED},
        ),
        ('<?xml version="1.0" encoding="gbk"?><mujoco><!-- 底座 --><worldbody>' + BODY + "</worldbody></mujoco>", {}),
        (
            "<mujoco><!-- 底座 --><worldbody><include file='part.xml'/></worldbody></mujoco>",
            {"part.xml": "<mujocoinclude><!-- 底座 -->" + BODY + "</mujocoinclude>"},
        ),
    ],
    ids=["dashes in comments", "beside the included file", "another encoding", "another encoding, included"],
)
def test_files_that_mujoco_reads(main, files, tmp_path, monkeypatch):
    for name, text in {"main.xml": main, **files}.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(text.encode("gbk"))
    scene = load_scene(tmp_path / "main.xml")
    assert scene.joint_names == ("j",)
    shutil.rmtree(tmp_path)
    assert scene_from_description(scene.description()).joint_names == ("j",)


def test_paths_are_shortened_before_links_are_followed(tmp_path):
    (tmp_path / "sub" / "deep").mkdir(parents=True)
    (tmp_path / "part.xml").write_text(INCLUDED)
    main = '<mujoco><worldbody><include file="../part.xml"/></worldbody></mujoco>'
    (tmp_path / "sub" / "deep" / "main.xml").write_text(main)
    (tmp_path / "link").symlink_to(tmp_path / "sub" / "deep")
    try:
        mujoco.MjSpec.from_file(str(tmp_path / "link" / "main.xml"))
    except ValueError:
        pytest.skip("MuJoCo before 3.4 follows links first")
    assert load_scene(tmp_path / "link" / "main.xml").joint_names == ("j",)


def test_what_cannot_be_stored_is_refused_by_name(tmp_path):
    with zipfile.ZipFile(tmp_path / "robot.mjz", "w") as archive:
        archive.writestr("model.xml", f"<mujoco><worldbody>{BODY}</worldbody></mujoco>")
    with pytest.raises(SceneError, match=r"robot\.mjz is an archive"):
        load_scene(tmp_path / "robot.mjz")


CORNERS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def without_files(scene: Scene, folder: Path) -> Scene | None:
    """Return the scene from its description; None if MuJoCo (before 3.4) reads such files only from the disk."""
    shutil.rmtree(folder)
    try:
        return scene_from_description(scene.description())
    except SceneError as error:
        assert "update to 3.4" in str(error) and not hasattr(mujoco, "MjVfs")
        return None


def test_attached_models_are_stored_with_their_files(tmp_path):
    (tmp_path / "robots" / "meshes").mkdir(parents=True)
    (tmp_path / "robots" / "meshes" / "part.obj").write_text(CORNERS)
    (tmp_path / "robots" / "link.xml").write_text(INCLUDED.replace('"p"', '"arm"'))
    (tmp_path / "robots" / "arm.xml").write_text(
        '<mujoco model="arm"><compiler meshdir="meshes"/>'
        '<asset><mesh name="m" file="part.obj" scale=".1 .1 .1"/></asset>'
        '<worldbody><include file="link.xml"/></worldbody></mujoco>'
    )
    (tmp_path / "main.xml").write_text(
        '<mujoco><asset><model name="arm" file="robots/arm.xml"/></asset><worldbody><frame pos="0 0 1">'
        '<attach model="arm" body="arm" prefix="left_"/></frame></worldbody></mujoco>'
    )
    scene = load_scene(tmp_path / "main.xml")
    if (again := without_files(scene, tmp_path)) is not None:
        assert "left_arm" in again.node_names and again.fingerprint() == scene.fingerprint()


def scaled_corners(size: float) -> str:
    """A tetrahedron as an OBJ file, ``size`` times the unit one."""
    return CORNERS.replace(" 1", f" {size}", 1).replace("0 1 0", f"0 {size} 0").replace("0 0 1", f"0 0 {size}")


def arm_of(folder: str, joint: str) -> str:
    return (
        f'<mujoco model="{joint}"><compiler meshdir="{folder}"/><asset><mesh file="part.obj"/></asset><worldbody>'
        f'<body name="arm"><joint name="{joint}"/><geom type="mesh" mesh="part"/></body></worldbody></mujoco>'
    )


ATTACH = '<frame pos="{0} 0 0"><attach model="{1}" body="arm" prefix="{1}_"/></frame>'
SHAPE = '<body><joint/><geom type="mesh" mesh="{}"/></body>'


@pytest.mark.parametrize(
    ("main", "files"),
    [
        (
            '<mujoco><compiler strippath="true" meshdir="a"/><asset><mesh file="/elsewhere/part.obj"/></asset>'
            "<worldbody>" + SHAPE.format("part") + "</worldbody></mujoco>",
            {"a/part.obj": scaled_corners(2)},
        ),
        (
            '<mujoco><asset><mesh name="one" file="a/part.obj"/><mesh name="two" file="b/part.obj"/></asset>'
            "<worldbody>" + SHAPE.format("one") + SHAPE.format("two") + "</worldbody></mujoco>",
            {"a/part.obj": CORNERS, "b/part.obj": scaled_corners(2)},
        ),
        (
            '<mujoco><asset><model name="l" file="left/arm.xml"/><model name="r" file="right/arm.xml"/></asset>'
            "<worldbody>" + ATTACH.format(0, "l") + ATTACH.format(9, "r") + "</worldbody></mujoco>",
            {"left/arm.xml": arm_of("../a", "one"), "right/arm.xml": arm_of("../b", "two")}
            | {"a/part.obj": CORNERS, "b/part.obj": scaled_corners(2)},
        ),
        (
            '<mujoco><include file="parts/robot.xml"/><worldbody>' + ATTACH.format(0, "l") + "</worldbody></mujoco>",
            {"parts/robot.xml": '<mujocoinclude><asset><model name="l" file="arm.xml"/></asset></mujocoinclude>'}
            | {"parts/arm.xml": arm_of("a", "one"), "parts/a/part.obj": scaled_corners(2)},
        ),
        (
            '<mujoco><include file="parts/robot.xml"/></mujoco>',
            {
                "parts/robot.xml": '<mujocoinclude><asset><mesh file="a/part.obj"/></asset><worldbody>'
                '<body><joint/><geom type="mesh" mesh="part" contype="0" conaffinity="0"/>'
                '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody></mujocoinclude>'
            }
            | {"parts/a/part.obj": scaled_corners(2)},
        ),
    ],
    ids=["stripped folders", "equal names", "attached, equal names", "attached in an include", "beside an include"],
)
@pytest.mark.filterwarnings("error::torchrl_gn.scenes.MissingMeshWarning")
def test_files_are_stored_from_wherever_mujoco_finds_them(main, files, tmp_path):
    for name, text in {"main.xml": main, **files}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    scene, plain = load_scene(tmp_path / "main.xml"), mujoco.MjModel.from_xml_path(str(tmp_path / "main.xml"))
    np.testing.assert_array_equal(scene.model.mesh_vert, plain.mesh_vert)
    if (again := without_files(scene, tmp_path)) is not None:
        np.testing.assert_array_equal(again.model.mesh_vert, plain.mesh_vert)
        assert again.joint_names == scene.joint_names and again.fingerprint() == scene.fingerprint()


def test_missing_pictures_take_no_stored_mesh_of_the_same_name(tmp_path):
    (tmp_path / "collision").mkdir()
    (tmp_path / "collision" / "part.obj").write_text(CORNERS)
    (tmp_path / "main.xml").write_text(
        '<mujoco><compiler meshdir="visual"/><asset><mesh name="seen" file="part.obj"/>'
        '<mesh name="felt" file="../collision/part.obj"/></asset><worldbody><body><joint/>'
        '<geom type="mesh" mesh="felt"/><geom type="mesh" mesh="seen" contype="0" conaffinity="0"/>'
        '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>'
    )
    with pytest.warns(MissingMeshWarning, match="seen"):
        scene = load_scene(tmp_path / "main.xml")
    assert scene.model.nmesh == 1 and scene_from_description(scene.description()).model.nmesh == 1


def test_files_of_flexes_are_stored(tmp_path):
    (tmp_path / "cloth.obj").write_text(CORNERS)
    (tmp_path / "main.xml").write_text(
        '<mujoco><worldbody><body name="soft" pos="0 0 2"><freejoint/><geom size=".01" mass="1"/>'
        '<flexcomp name="cloth" type="mesh" file="cloth.obj" rigid="true" scale=".1 .1 .1"/>'
        "</body></worldbody></mujoco>"
    )
    scene = load_scene(tmp_path / "main.xml")
    if (again := without_files(scene, tmp_path)) is not None:
        assert again.model.nflex == 1 and again.fingerprint() == scene.fingerprint()
