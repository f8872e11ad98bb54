"""Movable components and translation invariance against simulation."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from torchrl_gn.scenes import SYSTEMS, Scene, load_scene


def _simulate(scene: Scene, qpos: np.ndarray, steps: int, seed: int) -> np.ndarray:
    """States ``[steps + 1, N, 13]`` under random control."""
    rng = np.random.default_rng(seed)
    data = mujoco.MjData(scene.model)
    data.qpos[:] = qpos
    states = []
    for _ in range(steps + 1):
        mujoco.mj_forward(scene.model, data)
        states.append(data.sensordata.reshape(-1, 13).copy())
        data.ctrl[:] = rng.uniform(scene.action_low, scene.action_high)
        mujoco.mj_step(scene.model, data, scene.substeps)
    return np.array(states)


def _start(scene: Scene, seed: int = 0) -> np.ndarray:
    model = scene.model
    limited = model.jnt_limited.astype(bool)
    qpos = model.qpos0.copy()
    rng = np.random.default_rng(seed)
    for joint, start in enumerate(model.jnt_qposadr):
        if model.jnt_type[joint] >= int(mujoco.mjtJoint.mjJNT_SLIDE):
            low, high = model.jnt_range[joint] if limited[joint] else (-0.3, 0.3)
            qpos[start] = 0.5 * (low + high) + 0.3 * (high - low) * rng.uniform(-1, 1)
    return qpos


@pytest.mark.parametrize("name", [*SYSTEMS, "swimmer3"])
def test_live_channels_are_what_moves(name):
    scene = load_scene(name)
    states = _simulate(scene, _start(scene), 40, seed=1)
    rotation = np.empty((len(states) - 1, scene.num_nodes, 3))
    for step in range(len(states) - 1):
        for node in range(scene.num_nodes):
            before, after, delta = states[step, node, 3:7], states[step + 1, node, 3:7], np.empty(4)
            mujoco.mju_mulQuat(delta, after, before * [1, -1, -1, -1])  # world frame
            mujoco.mju_quat2Vel(rotation[step, node], delta, 1.0)
    change = np.concatenate([np.diff(states[..., :3], axis=0), rotation, np.diff(states[..., 7:], axis=0)], -1)
    largest = np.abs(change).max(axis=0)
    assert largest[~scene.movable].max(initial=0.0) < 1e-9
    assert largest[scene.movable].min() > 1e-7
    assert scene.movable.shape == (scene.num_nodes, 12)
    assert not scene.predicted[0] and scene.predicted[1:].all()


def test_live_channels_of_planar_systems():
    swimmer, cheetah, pendulum = (load_scene(name).movable[1] for name in ("swimmer6", "cheetah", "pendulum"))
    xy_plane, xz_plane, turn_y = [1, 1, 0, 0, 0, 1], [1, 0, 1, 0, 1, 0], [0, 0, 0, 0, 1, 0]
    for movable, expected in ((swimmer, xy_plane), (cheetah, xz_plane), (pendulum, turn_y)):
        np.testing.assert_array_equal(movable, expected * 2)


def _body(joints: str, geom: str = "", rest: str = "") -> str:
    return f"""
    <mujoco><option timestep="0.005"/><worldbody>
      {rest}
      <body name="b" pos="0 0 1" {geom}>{joints}<geom name="g" size=".2"/></body>
    </worldbody>%s</mujoco>"""


_SLIDES = '<joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>'
_FLOOR = '<geom type="plane" size="1 1 1"/>'
_MOTOR = '<actuator><motor joint="x" ctrlrange="-1 1"/></actuator>'
_SERVO = '<actuator><position joint="x" kp="9" ctrlrange="-1 1"/></actuator>'
_VELOCITY = '<actuator><velocity joint="x" kv="2" ctrlrange="-1 1"/></actuator>'

INVARIANCE = {
    "slides": (_body(_SLIDES) % "", "xz"),
    "free": (_body("<freejoint/>") % "", "xyz"),
    "free on a floor": (_body("<freejoint/>", rest=_FLOOR) % "", "xy"),
    "free on a box": (_body("<freejoint/>", rest='<geom type="box" size="1 1 .7"/>') % "", ""),
    "free on a slope": (
        _body("<freejoint/>", rest='<geom type="plane" size="1 1 1" euler="0 30 0"/>') % "",
        "y",
    ),
    "floor without contact": (
        _body("<freejoint/>", rest='<geom type="plane" size="1 1 1" contype="0" conaffinity="0"/>') % "",
        "xyz",
    ),
    "motor": (_body(_SLIDES) % _MOTOR, "xz"),
    "velocity servo": (_body(_SLIDES) % _VELOCITY, "xz"),
    "position servo": (_body(_SLIDES) % _SERVO, "z"),
    "limit": (_body(_SLIDES.replace('"1 0 0"', '"1 0 0" range="-.1 .1"')) % "", "z"),
    "spring": (_body(_SLIDES.replace('"1 0 0"', '"1 0 0" stiffness="50"')) % "", "z"),
    "turned slides": (_body(_SLIDES, geom='euler="0 25 0"') % "", "xz"),
    "turned limit": (
        _body(_SLIDES.replace('"1 0 0"', '"1 0 0" range="-.1 .1"'), geom='euler="0 25 0"') % "",
        "",
    ),
    "slide after hinge": (_body('<joint axis="0 1 0"/>' + _SLIDES) % "", ""),
    "hinge after slides": (_body(_SLIDES + '<joint axis="0 1 0"/>') % "", "xz"),
    "tied to the world": (
        _body("<freejoint/>") % '<equality><connect body1="b" anchor="0 0 .5"/></equality>',
        "",
    ),
    "two free bodies tied to each other": (
        _body("<freejoint/>", rest='<body name="c" pos="1 0 1"><freejoint/><geom size=".1"/></body>')
        % '<equality><connect body1="b" body2="c" anchor=".5 0 0"/></equality>',
        "xyz",
    ),
    "servo on a turning joint": (
        _body(_SLIDES + '<joint name="h" axis="0 1 0" range="-1 1"/>')
        % '<actuator><position joint="h" ctrlrange="-1 1"/></actuator>',
        "xz",
    ),
    "one tree fixed": (
        _body("<freejoint/>", rest='<body><joint axis="0 1 0"/><geom size=".1" pos="1 0 0"/></body>') % "",
        "",
    ),
    "tendon to the world": (
        _body('<freejoint/><site name="s"/>', rest='<site name="w"/>')
        % '<tendon><spatial stiffness="9" springlength=".1"><site site="s"/><site site="w"/></spatial></tendon>',
        "",
    ),
}


@pytest.mark.parametrize("case", INVARIANCE)
def test_invariance_of_small_models(case):
    xml, expected = INVARIANCE[case]
    assert "".join(np.array(list("xyz"))[load_scene(xml).translation_invariant]) == expected


def test_invariance_of_the_systems():
    expected = {"swimmer6": "xy", "cheetah": "x", "walker2d": "x"}
    for name in SYSTEMS:
        axes = np.array(list("xyz"))[load_scene(name).translation_invariant]
        assert "".join(axes) == expected.get(name, ""), name


def _shifted(scene: Scene, qpos: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Configuration whose every root body is ``shift`` further, by its free or slide joints."""
    model, qpos = scene.model, qpos.copy()
    before, after = mujoco.MjData(model), mujoco.MjData(model)
    before.qpos[:] = qpos
    mujoco.mj_kinematics(model, before)
    for joint in range(model.njnt):
        start = model.jnt_qposadr[joint]
        if scene.parent[scene.receivers[2 * joint]] == 0:
            if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
                qpos[start : start + 3] += shift
            elif model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
                qpos[start] += before.xaxis[joint] @ shift  # exact for orthogonal slides
    after.qpos[:] = qpos
    mujoco.mj_kinematics(model, after)
    np.testing.assert_allclose(after.xpos[scene.body[1:]] - before.xpos[scene.body[1:]] - shift, 0, atol=1e-12)
    return qpos


MOVABLE = {
    **{name: name for name in ("swimmer6", "cheetah", "walker2d")},
    **{case: xml for case, (xml, axes) in INVARIANCE.items() if axes},
}


@pytest.mark.parametrize("case", MOVABLE)
def test_shifted_start_gives_shifted_trajectory(case):
    scene = load_scene(MOVABLE[case])
    for axis in np.eye(3)[scene.translation_invariant]:
        qpos = _start(scene)
        near = _simulate(scene, qpos, 30, seed=2)
        far = _simulate(scene, _shifted(scene, qpos, 0.75 * axis), 30, seed=2)
        far[:, 1:, :3] -= 0.75 * axis
        np.testing.assert_allclose(far, near, atol=1e-7)


@pytest.mark.parametrize("case", ["free on a floor", "free on a slope", "position servo", "spring"])
def test_shift_along_another_axis_changes_the_trajectory(case):
    scene = load_scene(INVARIANCE[case][0])
    axis = np.array([0.0, 0.0, -0.9]) if case.startswith("free") else np.array([0.5, 0.0, 0.0])
    qpos = _start(scene)
    near = _simulate(scene, qpos, 30, seed=2)
    far = _simulate(scene, _shifted(scene, qpos, axis), 30, seed=2)
    far[:, 1:, :3] -= axis
    assert np.abs(far - near).max() > 1e-3


def test_cartpole_is_tied_to_its_rail():
    assert not load_scene("cartpole").translation_invariant.any()


def test_joints_that_damping_or_armature_locks_do_not_move():
    """The base of Gymnasium's Fetch has three slides with a damping of 1e11, which only rounding moves."""
    arm = """<mujoco><worldbody><body><joint type="slide" axis="1 0 0" {0}/><joint type="slide" axis="0 0 1" {0}/>
      <geom size=".1" mass="80"/><body pos="0 0 .2"><joint axis="0 1 0" pos=".1 0 0" damping="{1}"/>
      <geom size=".1" pos=".3 0 0"/></body></body></worldbody></mujoco>"""
    for lock in ('damping="1e11"', 'armature="1e11"'):
        scene = load_scene(arm.format(lock, 500))
        states = _simulate(scene, np.zeros(3), 40, seed=1)
        assert np.abs(np.diff(states[:, 1, :3], axis=0)).max() < 1e-9 and not scene.predicted[1]
        np.testing.assert_array_equal(scene.movable[2], [1, 0, 1, 0, 1, 0] * 2)
    assert load_scene(arm.format('damping="1e5"', 500)).predicted[1]
