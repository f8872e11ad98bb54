"""The yaw_frame of a scene against simulation: turned starts give turned trajectories."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from torchrl_gn.maths import BODY_STATE, quaternion
from torchrl_gn.scenes import SYSTEMS, Scene, load_scene

_PLANE = '<joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>'
_HINGE = '<joint name="turn" axis="0 0 1"/>'
_FLOOR = '<geom type="plane" size="1 1 1"/>'


def _scene(joints: str, options: str = "", rest: str = "", place: str = "", world: str = "") -> str:
    return f"""
    <mujoco><option timestep="0.005" {options}/><worldbody>{world}
      <body name="b" pos=".2 .1 1" {place}>{joints}
        <geom size=".2 .1 .1" type="ellipsoid" pos=".1 0 .05"/>
        <body name="c" pos=".3 0 0"><joint name="knee" axis="0 1 0"/><geom size=".1" pos=".2 .1 0"/></body>
      </body>
    </worldbody>{rest}</mujoco>"""


def _motor(joint: str, kind: str = "motor") -> str:
    return f'<actuator><{kind} joint="{joint}" ctrlrange="-1 1"/></actuator>'


YAW_FRAMES = {
    "hinge on the world": (_scene(_HINGE), True),
    "hinge in a plane": (_scene(_PLANE + _HINGE), True),
    "with a lift": (_scene('<joint type="slide" axis="0 0 1"/>' + _PLANE + _HINGE), True),
    "turned slides": (_scene(_PLANE + _HINGE, place='euler="0 0 30"'), True),
    "upside down": (_scene(_PLANE + _HINGE, place='euler="180 0 0"'), True),
    "driven": (_scene(_HINGE, rest=_motor("turn")), True),
    "speed servo": (_scene(_HINGE, rest=_motor("turn", "velocity")), True),
    "driven knee": (_scene(_PLANE + _HINGE, rest=_motor("knee", "position")), True),
    "in water": (_scene(_PLANE + _HINGE, 'density="1000" viscosity="0.1"'), True),
    "without weight": (_scene(_HINGE.replace("0 0 1", "1 0 0"), 'gravity="0 0 0"'), True),
    "touching the floor": (_scene(_HINGE, world=_FLOOR), False),
    "across gravity": (_scene(_HINGE.replace("0 0 1", "0 1 0")), None),
    "tilted": (_scene(_HINGE, place='euler="20 0 0"'), None),
    "in wind": (_scene(_HINGE, 'density="1" wind="1 0 0"'), None),
    "limited": (_scene(_HINGE.replace("/>", ' range="-90 90"/>')), None),
    "sprung": (_scene(_HINGE.replace("/>", ' stiffness="1"/>')), None),
    "position servo": (_scene(_HINGE, rest=_motor("turn", "position")), None),
    "one slide": (_scene(_PLANE[: _PLANE.index("/>") + 2] + _HINGE), None),
    "unlike slides": (_scene(_PLANE.replace('"1 0 0"', '"1 0 0" damping="3"') + _HINGE), None),
    "driven slide": (_scene(_PLANE + _HINGE, rest=_motor("x")), None),
    "another hinge": (_scene(_HINGE + '<joint axis="0 1 0"/>'), None),
    "free": (_scene("<freejoint/>"), None),
    "tied": (_scene(_HINGE, rest='<equality><connect body1="c" anchor="0 0 0"/></equality>'), None),
    "two trees": (
        _scene(_HINGE, world=f'<body pos="2 0 0">{_HINGE.replace("turn", "t2")}<geom size=".1"/></body>'),
        None,
    ),
}


@pytest.mark.parametrize("case", YAW_FRAMES)
def test_heading_of_small_models(case):
    xml, exact = YAW_FRAMES[case]
    yaw_frame = load_scene(xml).yaw_frame
    assert (None if yaw_frame is None else yaw_frame.exact) is exact


def test_heading_of_the_systems():
    for name in SYSTEMS:
        yaw_frame = load_scene(name).yaw_frame
        assert (None if yaw_frame is None else yaw_frame.exact) == {"swimmer6": True, "jaco": False}.get(name), name
    assert "rotation-invariant about z\n" in str(load_scene("swimmer6"))
    assert "about z but for contacts with the world" in str(load_scene("jaco"))
    assert "rotation-invariant about no axis" in str(load_scene("cheetah"))


def _simulate(scene: Scene, qpos: np.ndarray, qvel: np.ndarray) -> torch.Tensor:
    rng = np.random.default_rng(1)
    data = mujoco.MjData(scene.model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    states = []
    for _ in range(20):
        mujoco.mj_forward(scene.model, data)
        states.append(data.sensordata[scene.sensor_slice].reshape(-1, 13).copy())
        data.ctrl[:] = rng.uniform(scene.action_low, scene.action_high)
        mujoco.mj_step(scene.model, data, scene.substeps)
    return torch.as_tensor(np.array(states))


@pytest.mark.parametrize("case", [*(case for case, (_, exact) in YAW_FRAMES.items() if exact), "swimmer6"])
def test_turned_start_gives_turned_trajectory(case):
    scene = load_scene(YAW_FRAMES[case][0] if case in YAW_FRAMES else case)
    model, yaw_frame = scene.model, scene.yaw_frame
    assert yaw_frame is not None
    rng = np.random.default_rng(0)
    qpos, qvel = model.qpos0 + rng.uniform(-0.3, 0.3, model.nq), rng.uniform(-1, 1, model.nv)
    turned_qpos, turned_qvel = qpos.copy(), qvel.copy()
    hinge = next(j for j in range(model.njnt) if model.jnt_type[j] == int(mujoco.mjtJoint.mjJNT_HINGE))
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    axis, angle = data.xaxis[hinge], 0.7
    turned_qpos[model.jnt_qposadr[hinge]] += angle
    slides = [j for j in range(hinge) if abs(data.xaxis[j] @ axis) < 0.5]
    if slides:  # the velocity along the slides turns too
        directions = data.xaxis[slides]
        turn = np.empty(4)
        mujoco.mju_axisAngle2Quat(turn, axis, angle)
        velocity, turned = qvel[slides] @ directions, np.empty(3)
        mujoco.mju_rotVecQuat(turned, velocity, turn)
        turned_qvel[slides] = directions @ turned
    states, turned = (_simulate(scene, *start) for start in ((qpos, qvel), (turned_qpos, turned_qvel)))
    rotation = torch.as_tensor(angle * axis)
    pivot = torch.zeros(13, dtype=torch.float64)
    pivot[:3] = torch.as_tensor(data.xanchor[hinge])
    if not slides:
        across = [index for index in range(3) if index != yaw_frame.axis]
        np.testing.assert_allclose(yaw_frame.pivot[across], pivot[across], atol=1e-12)
    expected = BODY_STATE.rotate(states - pivot, quaternion.exp(rotation)) + pivot
    sign = (turned[..., 3:7] * expected[..., 3:7]).sum(-1, keepdim=True).sign()
    expected[..., 3:7] *= sign
    np.testing.assert_allclose(turned[:, 1:], expected[:, 1:], atol=1e-7)


@pytest.mark.parametrize("case", ["across gravity", "in wind", "sprung", "unlike slides", "position servo"])
def test_what_has_no_heading_moves_differently_when_turned(case):
    scene = load_scene(YAW_FRAMES[case][0])
    model = scene.model
    hinge = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, "turn")
    knee = model.jnt_dofadr[mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, "knee")]
    speed = []
    for angle in (0.0, 0.7):
        data = mujoco.MjData(model)
        data.qpos[model.jnt_qposadr[hinge]] = angle
        data.qvel[:] = 1.0
        mujoco.mj_step(model, data, 40)
        speed.append(data.qvel[[model.jnt_dofadr[hinge], knee]].copy())
    assert np.abs(speed[0] - speed[1]).max() > 1e-4
