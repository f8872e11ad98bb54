"""Start states of models from MJCF: keyframes, joint limits, contacts, the ground, equality constraints."""

from __future__ import annotations

import warnings

import mujoco
import numpy as np
import pytest

from torchrl_gn.data import StartPoseWarning, collect_trajectories, sample_start_states
from torchrl_gn.scenes import Scene, load_scene, scene_from_description

ROBOT = """
<mujoco model="robot">
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <geom name="table" type="box" size=".3 .3 .2" pos="1 0 .2"/>
    <body name="cup" pos="1 0 .45"><freejoint/><geom name="cup" type="cylinder" size=".04 .05"/></body>
    <body name="base" pos="0 0 .6"><freejoint/><geom type="box" size=".15 .1 .05"/>
      <body name="thigh" pos=".1 0 0">
        <joint name="hip" axis="0 1 0" range="-100 100"/><geom type="capsule" size=".03" fromto="0 0 0 0 0 -.25"/>
        <body name="shin" pos="0 0 -.25">
          <joint name="knee" axis="0 1 0" range="-150 0"/><geom type="capsule" size=".03" fromto="0 0 0 0 0 -.3"/>
        </body>
      </body>
    </body>
  </worldbody>
  <keyframe>
    <key name="crouch" qpos="1 0 .45 1 0 0 0  0 0 .4 1 0 0 0  .8 -1.6"/>
    <key name="home" qpos="1.1 .1 .45 1 0 0 0  0 0 .7 1 0 0 0  .4 -.8" qvel="0 0 0 0 0 0 1 1 1 1 1 1 1 1"/>
  </keyframe>
</mujoco>
"""
HOME = np.array([1.1, 0.1, 0.45, 1, 0, 0, 0, 0, 0, 0.7, 1, 0, 0, 0, 0.4, -0.8])


def _qpos(scene: Scene, n: int = 300, seed: int = 0) -> np.ndarray:
    states, nq = sample_start_states(scene, n, seed), scene.model.nq
    assert not states[:, 0].any() and not states[:, 1 + nq : 1 + nq + scene.model.nv].any()
    return states[:, 1 : 1 + nq]


def _contacts(scene: Scene, qpos: np.ndarray) -> mujoco.MjData:
    data = mujoco.MjData(scene.model)
    data.qpos[:] = qpos
    mujoco.mj_forward(scene.model, data)
    return data


def test_starts_do_not_collide_and_stand_on_the_ground() -> None:
    scene = load_scene(ROBOT)
    qpos = _qpos(scene)
    hip, knee = qpos[:, 14], qpos[:, 15]
    assert hip.min() < -1.5 and hip.max() > 1 and knee.min() < -2.4 and knee.max() > -0.2
    near = (abs(hip - 0.4) < 0.3 * 2.2) & (abs(knee + 0.8) < 0.3 * 1.9)
    assert 0.5 < near.mean() < 0.8  # half of the starts, and some of the others
    np.testing.assert_allclose(qpos[:, 2], 0.45, atol=1e-12)  # the cup stays on its table
    assert (abs(qpos[:, :2] - [1.1, 0.1]) < 0.07).all() and np.ptp(qpos[:, 0]) > 0.05
    for cup_or_base in (qpos[:, 3:7], qpos[:, 10:14]):
        yaw = 2 * np.arctan2(cup_or_base[:, 3], cup_or_base[:, 0])
        assert np.histogram(np.angle(np.exp(1j * yaw)), 4, (-np.pi, np.pi))[0].min() > 30
    upright = np.empty(9)
    feet = []
    for row in qpos:
        data = _contacts(scene, row)
        assert data.contact.dist.min(initial=0.0) > -1.0001e-3
        mujoco.mju_quat2Mat(upright, row[10:14])
        assert upright[8] > np.cos(0.75)
        distances = [mujoco.mj_geomDistance(scene.model, data, 0, geom, 9.0, None) for geom in (3, 4, 5)]
        feet.append(min(distances))
    data = _contacts(scene, HOME)
    np.testing.assert_allclose(feet, mujoco.mj_geomDistance(scene.model, data, 0, 5, 9.0, None), atol=1e-9)


@pytest.mark.parametrize(("old", "new", "knee"), [("home", "stand", -0.8), ("home", "end", -1.6), ("<key", "<!--", 0)])
def test_reference_pose_is_a_keyframe(old: str, new: str, knee: float) -> None:
    """``stand`` comes after ``home``, then the first. Starts are at most 30 % of a joint's range away from it."""
    text = ROBOT.replace(old, new) if new != "<!--" else ROBOT[: ROBOT.index("<keyframe>")] + "</mujoco>"
    away = abs(_qpos(load_scene(text, wide_starts=0), 100)[:, 15] - knee)
    assert away.min() < 0.02 and away.max() < 0.3 * np.deg2rad(150)


def test_the_share_of_wide_starts_is_part_of_the_description() -> None:
    reference = _qpos(load_scene(ROBOT, wide_starts=0), 1)
    far = []
    for share in (0, 0.5, 1):
        scene = load_scene(ROBOT, wide_starts=share)
        assert scene_from_description(scene.description()).wide_starts == scene.wide_starts == share
        far.append(float(np.abs(_qpos(scene) - reference)[:, 14:].mean()))
    assert far[0] < far[1] < far[2]
    with pytest.raises(ValueError, match="wide_starts must be a share"):
        load_scene(ROBOT, wide_starts=2)
    with pytest.raises(ValueError, match="start states of its own"):
        load_scene("cheetah", wide_starts=0)


def test_a_base_in_the_ground_is_lifted_until_it_touches() -> None:
    scene = load_scene(ROBOT.replace("0 0 .7 1", "0 0 .2 1"))
    with warnings.catch_warnings():
        warnings.simplefilter("error", StartPoseWarning)
        qpos = _qpos(scene, 50)
    for row in qpos:
        lowest = min(_contacts(scene, row).contact.dist, default=1.0)
        assert lowest == pytest.approx(0.0, abs=1e-6) or lowest == 1.0


def test_planar_bases_are_lifted() -> None:
    scene = load_scene(
        """<mujoco><worldbody><geom type="plane" size="1 1 1"/><body pos="0 0 .5">
          <joint name="z" type="slide" axis="0 0 -1"/><joint name="pitch" axis="0 1 0"/>
          <geom type="capsule" size=".05" fromto="0 0 -.4 0 0 .4"/></body></worldbody></mujoco>"""
    )
    qpos = _qpos(scene)
    assert np.ptp(qpos[:, 1]) > 6
    height = 0.5 - qpos[:, 0] - 0.4 * abs(np.cos(qpos[:, 1])) - 0.05
    np.testing.assert_allclose(height, 0.05, atol=1e-9)  # as in the reference pose


def test_a_reference_pose_that_penetrates_is_told_and_avoided() -> None:
    arm = """<mujoco model="bent"><worldbody><body><geom name="post" type="box" size=".05 .05 .4" pos="0 0 .4"/>
      <body pos="0 0 1"><joint axis="0 1 0"/><geom type="capsule" size=".03" fromto="0 0 0 .4 0 0"/>
        <body pos=".4 0 0"><joint axis="0 1 0"/><geom name="fore" type="capsule" size=".03" fromto="0 0 0 .4 0 0"/>
      </body></body></body></worldbody><keyframe><key qpos=".5 2.5"/></keyframe></mujoco>"""
    told = r"'bent' has geom '(post|fore)' \d+.* mm deep in geom .* {} .* keyframe 'home'"
    scene = load_scene(arm)
    with pytest.warns(StartPoseWarning, match=told.format("are around a random pose")):
        qpos = _qpos(scene, 100)
    assert all(_contacts(scene, row).contact.dist.min(initial=0.0) > -1.0001e-3 for row in qpos)
    inside = load_scene(arm.replace('".05 .05 .4"', '".05 .05 .62"').replace(".5 2.5", "0 0"))  # in every pose
    with pytest.warns(StartPoseWarning, match="has a geom of body 'body2' .* mm deep in geom 'post'"):
        assert np.ptp(_qpos(inside, 50), axis=0).min() > 1


@pytest.mark.parametrize("jacobian", ["dense", "sparse"])
def test_equality_constraints_hold(jacobian: str) -> None:
    """A parallelogram closed by a connection, and a finger that follows another."""
    scene = load_scene(
        f"""<mujoco><option gravity="0 0 0" jacobian="{jacobian}"/><worldbody>
          <body name="a"><joint name="a" axis="0 1 0"/><geom size=".02" pos="0 0 .3"/>
            <body name="bar" pos="0 0 .3"><joint name="bar" axis="0 1 0"/><geom size=".02" pos=".2 0 0"/></body></body>
          <body name="b" pos=".4 0 0"><joint name="b" axis="0 1 0"/><geom size=".02" pos="0 0 .3"/></body>
          <body pos="2 0 0"><joint name="left" type="slide" range="0 .1"/><geom size=".01"/></body>
          <body pos="3 0 0"><joint name="right" type="slide" range="-.2 .2"/><geom size=".01"/></body>
        </worldbody><equality>
          <connect body1="bar" body2="b" anchor=".4 0 0"/><joint joint1="right" joint2="left" polycoef="0 -2 0 0 0"/>
        </equality></mujoco>"""
    )
    qpos = _qpos(scene, 50)
    np.testing.assert_allclose(qpos[:, 4], -2 * qpos[:, 3], atol=1e-3)
    tip = np.stack([0.3 * np.sin(qpos[:, 0]) + 0.4 * np.cos(qpos[:, 0] + qpos[:, 1])], -1)
    np.testing.assert_allclose(tip[:, 0], 0.4 + 0.3 * np.sin(qpos[:, 2]), atol=1e-3)
    assert np.ptp(qpos[:, 0]) > 2 and np.ptp(qpos[:, 3]) > 0.08
    assert -0.006 < qpos[:, 3].min() and qpos[:, 3].max() < 0.106


def test_what_touches_nothing_turns_in_place() -> None:
    body = '<body pos="1 2 3"><freejoint/><geom size=".1" type="box" {}/></body>'
    flags = ('contact="disable"', 'constraint="disable"', 'gravity="disable"')
    for rest in ('<option gravity="0 0 0"/>', *(f"<option><flag {flag}/></option>" for flag in flags), ""):
        geom = "" if rest else 'contype="0" conaffinity="0"'
        world = f'<worldbody><geom type="plane" size="1 1 1"/>{body.format(geom)}</worldbody>'
        qpos = _qpos(load_scene(f"<mujoco>{rest}{world}</mujoco>".replace('size=".1"', 'size=".1 .1 .1"')), 400)
        if not rest or "contact" in rest:
            assert (qpos[:, :3] == [1, 2, 3]).all()
        assert qpos[:, 3].min() < 0.2


@pytest.mark.filterwarnings("ignore::torchrl_gn.data.UncontrolledSceneWarning")
def test_a_keyframe_places_mocap_bodies_in_the_simulation_too():
    """A weld holds to the keyframe's target, not to the file's, as in the bimanual tasks of mujoco_mpc."""
    held = """<mujoco model="held"><option gravity="0 0 0"/><worldbody>
      <body name="target" mocap="true" pos=".1 0 0"/><body name="hand"><freejoint/><geom size=".1" mass="1"/></body>
      <body name="other" mocap="true" pos="0 3 0" quat="0 1 0 0"/></worldbody>
      <equality><weld body1="target" body2="hand" relpose="0 0 0 1 0 0 0"/></equality>{}</mujoco>"""
    key = '<keyframe><key name="home" mpos="1 0 0 0 4 0" mquat="1 0 0 0 0 1 0 0" qpos="1 0 0 1 0 0 0"/></keyframe>'
    for text, place in ((held.format(key), 1.0), (held.format(""), 0.1)):
        scene = load_scene(text)
        data = collect_trajectories(scene, 3, steps=20, seed=0)
        np.testing.assert_allclose(data["state"][:, :, 1, 0], place, atol=1e-4)
        assert data["state"][..., 7:].abs().max() < 1e-2
        again = scene_from_description(scene.description())
        np.testing.assert_array_equal(again.model.body_pos, scene.model.body_pos)
    bare = load_scene(held.format('<keyframe><key qpos="0 0 0 1 0 0 0"/></keyframe>'))  # names no mocap pose
    target, other = (bare.model.body(name) for name in ("target", "other"))
    np.testing.assert_array_equal([target.pos, other.pos], [[0.1, 0, 0], [0, 3, 0]])
    np.testing.assert_array_equal(other.quat, [0, 1, 0, 0])


REACH = """<mujoco model="reach"><worldbody>
  <body name="target" mocap="true" pos="{} 0 0"/>
  <body name="upper"><joint name="shoulder" axis="0 1 0" range="-170 170"/>
    <geom type="capsule" fromto="0 0 0 .5 0 0" size=".03"/>
    <body name="lower" pos=".5 0 0" euler="0 2 0"><joint name="elbow" axis="0 1 0" range="-170 170"/>
      <geom type="capsule" fromto="0 0 0 .5 0 0" size=".03"/>
      <body name="hand" pos=".5 0 0"><joint name="wrist" axis="0 1 0" range="-170 170"/><geom size=".04"/></body></body>
    </body></worldbody>
  <equality><weld body1="target" body2="hand" relpose="0 0 0 1 0 0 0"/></equality></mujoco>"""


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::torchrl_gn.data.UncontrolledSceneWarning")
@pytest.mark.parametrize("distance", [0.6, 0.99, 1.5])
def test_a_weld_to_a_far_target_winds_no_joint_up(distance):
    """The arm resembles Meta-World's Sawyer: nearly straight, with a weld of its hand; 1.5 m are out of reach."""
    scene = load_scene(REACH.format(distance))
    data = collect_trajectories(scene, 4, steps=50, seed=0)
    angles = data["physics"][:, :, 1:4].rad2deg()
    assert angles.abs().max() < 172
    if distance < 1:
        np.testing.assert_allclose(data["state"][:, :, 3, 0], distance, atol=1e-3)
        assert data["state"][..., 10:13].abs().max() < 1
    if distance == 0.6:  # where MuJoCo settles by itself, with the elbow on either side
        np.testing.assert_allclose(angles[:, 0, ::2].abs(), 53, atol=1)
        np.testing.assert_allclose(angles[:, 0].sum(-1), -2, atol=1)


@pytest.mark.parametrize("limit", [30, 120])
def test_balls_start_within_their_limits(limit) -> None:
    """The keyframe may be beyond the limits; so may the shortest rotation between two orientations."""
    scene = load_scene(
        f"""<mujoco><worldbody><body pos="0 0 1"><joint type="ball" range="0 {limit}"/><geom size=".1"/></body>
        </worldbody><keyframe><key name="home" qpos="-.5 0 -.8660254 0"/></keyframe></mujoco>"""
    )
    turns = sample_start_states(scene, 500, 0)[:, 1:5]
    angles = np.degrees(2 * np.arccos(np.abs(turns[:, 0]).clip(0, 1)))
    assert angles.max() <= limit + 1e-6 and angles.max() > 0.9 * limit


def test_limits_that_stand_for_none_send_no_joint_far_away() -> None:
    """Files write "unlimited" as a large number; a keyframe far beyond such a limit stays near it."""
    scene = load_scene(
        """<mujoco><compiler angle="radian"/><worldbody><body>
        <joint name="slide" type="slide" axis="1 0 0" range="-10000 10000"/>
        <joint name="hinge" axis="0 0 1" range="-100000 100000"/><joint name="turns" axis="0 1 0" range="-12 12"/>
        <geom size=".1" pos=".2 0 0"/></body></worldbody>
        <keyframe><key name="home" qpos="-9999.9 2 0"/></keyframe></mujoco>"""
    )
    slide, hinge, turns = _qpos(scene).T
    extent = scene.model.stat.extent
    assert (-10000 <= slide).all() and 0.5 * extent < np.ptp(slide) <= 2 * extent
    assert abs(hinge - 2).max() <= np.pi and np.ptp(hinge) > np.pi
    assert abs(turns).max() > 10  # two turns are limits


FINGER = """<mujoco><option>{}</option><worldbody>
  <body pos="0 0 1"><joint name="j" axis="0 1 0" range="-170 170"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/>
    <body pos=".3 0 0"><joint name="k" axis="0 1 0" range="-170 170"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/><site name="tip" pos=".3 0 0"/></body></body>
  <site name="anchor" pos="0 0 1.3"/></worldbody>
  <tendon><fixed range="-.2 .2"><joint joint="j" coef="1"/><joint joint="k" coef="1"/></fixed>
    <spatial range="0 .6"><site site="anchor"/><site site="tip"/></spatial></tendon>
  <keyframe><key name="home" qpos="0 1"/></keyframe></mujoco>"""


@pytest.mark.filterwarnings("ignore:Data of scene .* show no control")
def test_tendons_start_within_their_limits() -> None:
    """Beyond a tendon's limit a start flies off: fingers moved by up to 92 rad/s after one control step."""
    scene = load_scene(FINGER.format(""))
    data, lengths = mujoco.MjData(scene.model), []
    for pose in _qpos(scene, 100):
        data.qpos[:] = pose
        mujoco.mj_forward(scene.model, data)
        lengths.append(data.ten_length.copy())
    fixed, spatial = np.array(lengths).T
    assert abs(fixed).max() < 0.2 + 1e-3 and spatial.max() < 0.6 + 1e-3
    assert np.ptp(fixed) > 0.3 and np.ptp(spatial) > 0.2
    speeds = collect_trajectories(scene, 20, 1, seed=0)["state"][:, -1, :, 10:].norm(dim=-1)
    assert speeds.max() < 10


def test_limits_of_tendons_that_are_switched_off_do_not_bound_starts() -> None:
    pose = _qpos(load_scene(FINGER.format('<flag limit="disable"/>')), 100)
    assert abs(pose.sum(1)).max() > 2


HELD = """<mujoco><worldbody><geom type="plane" size="5 5 .1"/>
  <body name="arm" pos="0 0 1"><joint axis="0 1 0" range="-60 60"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/></body>
  <body name="box" pos=".45 0 1"><freejoint/><geom type="box" size=".05 .05 .05"/></body>
  <body name="lamp" pos="0 2 .8"><freejoint/><geom type="capsule" fromto="0 0 0 0 0 -.2" size=".03"/></body>
  <body name="left" pos="0 4 .1"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
  <body name="right" pos=".3 4 .1"><freejoint/><geom type="box" size=".1 .1 .1"/></body></worldbody>
  <equality><weld body1="arm" body2="box"/><connect body1="lamp" anchor="0 0 .2"/>
    <weld body1="left" body2="right"/></equality></mujoco>"""


def test_bodies_that_constraints_hold_above_the_ground_stay_there() -> None:
    """Bodies on the ground keep their clearance; a box in a gripper over the ground must not leave the gripper."""
    scene = load_scene(HELD)
    data, errors, poses = mujoco.MjData(scene.model), [], _qpos(scene, 40)
    for pose in poses:
        data.qpos[:] = pose
        mujoco.mj_forward(scene.model, data)
        rows = data.efc_type[: data.nefc] == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        errors.append(np.abs(data.efc_pos[: data.nefc][rows]).max())
    assert max(errors) < 1e-3
    assert np.ptp(poses[:, 3]) > 0.3  # height of the box
    np.testing.assert_allclose(poses[:, [17, 24]], 0.1, atol=2e-3)
