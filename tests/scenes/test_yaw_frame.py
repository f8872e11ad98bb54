"""The yaw_frame of a scene against simulation: turned starts give turned trajectories."""

from __future__ import annotations

import copy
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from numpy.typing import ArrayLike

from torchrl_gn.maths import BODY_STATE, quaternion
from torchrl_gn.scenes import SYSTEMS, Scene, load_scene
from torchrl_gn.scenes.invariance import movable_components, translation_invariant
from torchrl_gn.scenes.topology import topology
from torchrl_gn.scenes.yaw_frame import YawFrame, find_yaw_frame

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
    "tied": (_scene(_HINGE, rest='<equality><connect body1="c" anchor="0 0 0"/></equality>'), None),
    "two trees": (
        _scene(_HINGE, world=f'<body pos="2 0 0">{_HINGE.replace("turn", "t2")}<geom size=".1"/></body>'),
        None,
    ),
}


FREE, BALL, SLIDES = "<freejoint/>", '<joint type="ball"/>', _PLANE + '<joint type="slide" axis="0 0 1"/>'
ELLIPTIC = 'cone="elliptic"'
_OBJECT = '<body name="object" pos="1 1 .2"><freejoint/><geom size=".1"/></body>'


def _floor(condim: int) -> str:
    return f'<geom type="plane" size="9 9 1" condim="{condim}"/>'


def _root_motor(gear: str, kind: str = "joint", root: str = '<joint name="root" type="free"/>') -> str:
    return _scene(root, rest=f'<actuator><motor {kind}="root" gear="{gear}" ctrlrange="-1 1"/></actuator>')


_CAPSULES = (
    _scene(FREE, world=_FLOOR)
    .replace('type="ellipsoid"', 'type="capsule"')
    .replace('<geom size=".1" pos', "<geom size='.1 .1' type='capsule' pos")
)
_SLIPPERY = _scene(FREE, world=_FLOOR).replace("<geom ", '<geom condim="1" ')
FREE_ROOTS = {
    "free": (_scene(FREE), True),
    "free, turned": (_scene(FREE, place='euler="20 30 40"'), True),
    "free in water": (_scene(FREE, 'density="1000" viscosity="0.1"'), True),
    "free without weight": (_scene(FREE, 'gravity="0 0 0"'), True),
    "free, turned, in water without weight": (
        _scene(FREE, 'gravity="0 0 0" density="1000"', place='euler="20 30 40"'),
        True,
    ),
    "free, weight along y": (_scene(FREE, 'gravity="0 9 0"'), True),
    "free with damping": (_scene('<joint type="free" damping="1" armature=".1"/>'), True),
    "free on a floor": (_scene(FREE, ELLIPTIC, world=_FLOOR), True),
    "free on a floor, rolling": (_scene(FREE, ELLIPTIC, world=_floor(6)), True),
    "free on a ceiling": (
        _scene(
            FREE, ELLIPTIC + ' gravity="0 0 9"', world='<geom type="plane" size="1 1 1" pos="0 0 2" euler="180 0 0"/>'
        ),
        True,
    ),
    "free on ice": (_SLIPPERY, True),
    "capsules on a floor": (_CAPSULES, True),
    "pushed up": (_root_motor("0 0 9 0 0 0"), True),
    "spun about its own axes": (_root_motor("0 0 0 1 2 3"), True),
    "spun about the vertical": (_root_motor("0 0 9 0 0 1", "jointinparent"), True),
    "ball": (_scene(BALL), True),
    "ball, spun": (_root_motor("1 2 3", root='<joint name="root" type="ball"/>'), True),
    "ball on slides": (_scene(SLIDES + BALL), True),
    "ball on a floor": (_scene(BALL, ELLIPTIC, world=_FLOOR.replace("/>", ' pos="0 0 .85"/>')), True),
    "two free bodies": (_scene(FREE, ELLIPTIC, world=_FLOOR + _OBJECT), True),
    "a turntable and a free body": (_scene(_HINGE, ELLIPTIC, world=_FLOOR + _OBJECT), True),
    "turntables on one axis": (
        _scene(
            _HINGE,
            ELLIPTIC,
            world='<body pos=".2 .1 2"><joint axis="0 0 1"/><geom size=".1 .3" type="capsule"/></body>',
        ),
        True,
    ),
    "friction pyramids": (_scene(FREE, world=_FLOOR), False),
    "friction pyramids between bodies": (
        _scene(FREE, world='<body pos=".3 .1 .5"><freejoint/><geom size=".8"/></body>'),
        False,
    ),
    "unlike friction": (
        _scene(FREE, ELLIPTIC, world='<geom name="floor" type="plane" size="1 1 1"/>')
        .replace('<geom size=".1"', '<geom name="foot" size=".1"')
        .replace(
            "</mujoco>",
            '<contact><pair geom1="floor" geom2="foot" condim="4" friction="1 .1 .1 .1 .1"/></contact></mujoco>',
        ),
        False,
    ),
    "a wall": (
        _scene(FREE, ELLIPTIC, world=_FLOOR + '<geom type="plane" size="1 1 1" pos=".6 0 0" euler="0 90 0"/>'),
        False,
    ),
    "a slope": (_scene(FREE, ELLIPTIC, world='<geom type="plane" size="1 1 1" euler="0 10 0"/>'), False),
    "a box": (_scene(FREE, ELLIPTIC, world='<geom type="box" size=".3 .3 .7"/>'), False),
    "terrain": (
        _scene(FREE, ELLIPTIC, world='<geom type="hfield" hfield="hills"/>').replace(
            "<worldbody>",
            '<asset><hfield name="hills" nrow="2" ncol="2" elevation="0 1 0 1" size="2 2 .7 .1"/></asset><worldbody>',
        ),
        False,
    ),
    "free in a side wind": (_scene(FREE, 'density="1" wind="1 0 0"'), None),
    "free, weight askew": (_scene(FREE, 'gravity="1 0 -9"'), None),
    "free, sprung": (_scene('<joint type="free" stiffness="9"/>'), None),
    "free, dry friction": (_scene('<joint type="free" frictionloss="2"/>'), None),
    "free, tied": (_scene(FREE, rest='<equality><connect body1="c" anchor="0 0 0"/></equality>'), None),
    "on a spring to the world": (
        _scene(FREE, world='<site name="hook" pos="1 0 0"/>')
        .replace('<geom size=".1"', '<site name="tip"/><geom size=".1"')
        .replace(
            "</mujoco>",
            '<tendon><spatial stiffness="9"><site site="hook"/><site site="tip"/></spatial></tendon></mujoco>',
        ),
        None,
    ),
    "pushed sideways": (_root_motor("9 0 0 0 0 0"), None),
    "spun about the world's axes": (_root_motor("0 0 0 1 0 0", "jointinparent"), None),
    "ball, sprung": (_scene('<joint type="ball" stiffness="9"/>'), None),
    "ball, limited": (_scene('<joint type="ball" range="0 10"/>'), None),
    "ball, spun about the world's axes": (
        _root_motor("1 2 3", "jointinparent", '<joint name="root" type="ball"/>'),
        None,
    ),
    "turntables apart": (
        _scene(_HINGE, world=f'<body pos="2 0 0">{_HINGE.replace("turn", "t2")}<geom size=".1"/></body>'),
        None,
    ),
    "a cart and a free body": (_scene(_PLANE[: _PLANE.index("/>") + 2], world=_OBJECT), None),
}


@pytest.mark.parametrize("case", YAW_FRAMES | FREE_ROOTS)
def test_heading_of_small_models(case):
    xml, exact = (YAW_FRAMES | FREE_ROOTS)[case]
    yaw_frame = load_scene(xml).yaw_frame
    assert (None if yaw_frame is None else yaw_frame.exact) is exact


@pytest.mark.slow
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
        states.append(data.sensordata.reshape(-1, 13).copy())
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


# Free roots: any model and state, rotated and shifted


def _frame(model: mujoco.MjModel) -> YawFrame | None:
    """Yaw frame of a model that need not be a scene: its actuators may be of any kind."""
    graph, data = topology(model), mujoco.MjData(model)
    movable = movable_components(model, data, graph.body)
    mujoco.mj_resetData(model, data)
    mujoco.mj_kinematics(model, data)
    return find_yaw_frame(model, data, graph, movable)


def _rotate(model: mujoco.MjModel, start: mujoco.MjData, axis: int, angle: float, pivot, shift) -> mujoco.MjData:
    """A state rotated about an axis through ``pivot``, then shifted: by the roots' coordinates."""
    data, rest = copy.copy(start), mujoco.MjData(model)
    mujoco.mj_kinematics(model, rest)
    turn, matrix, conjugate, product = np.empty(4), np.empty(9), np.empty(4), np.empty(4)
    mujoco.mju_axisAngle2Quat(turn, np.eye(3)[axis], angle)
    mujoco.mju_quat2Mat(matrix, turn)
    matrix = matrix.reshape(3, 3)
    for body in np.flatnonzero((model.body_weldid[model.body_parentid] == 0) & (model.body_weldid != 0)):
        slides = []
        for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            at, dof, kind = model.jnt_qposadr[joint], model.jnt_dofadr[joint], mujoco.mjtJoint
            match int(model.jnt_type[joint]):
                case kind.mjJNT_FREE:
                    data.qpos[at : at + 3] = matrix @ (start.qpos[at : at + 3] - pivot) + pivot + shift
                    mujoco.mju_mulQuat(product, turn, start.qpos[at + 3 : at + 7])
                    data.qpos[at + 3 : at + 7] = product
                    data.qvel[dof : dof + 3] = matrix @ start.qvel[dof : dof + 3]
                case kind.mjJNT_BALL:
                    mujoco.mju_negQuat(conjugate, rest.xquat[body])
                    mujoco.mju_mulQuat(product, turn, rest.xquat[body])
                    mujoco.mju_mulQuat(product, conjugate, product.copy())
                    mujoco.mju_mulQuat(product, product.copy(), start.qpos[at : at + 4])
                    data.qpos[at : at + 4] = product
                case kind.mjJNT_HINGE if abs(rest.xaxis[joint][axis]) > 0.5:
                    data.qpos[at] += angle * rest.xaxis[joint][axis]
                case kind.mjJNT_SLIDE:
                    slides.append(joint)
        if len(slides) > 1:
            directions, at, dof = rest.xaxis[slides], model.jnt_qposadr[slides], model.jnt_dofadr[slides]
            anchor = rest.xanchor[slides[0]]
            place = anchor - pivot + start.qpos[at] @ directions
            data.qpos[at] = directions @ (matrix @ place + pivot + shift - anchor)
            data.qvel[dof] = directions @ matrix @ (start.qvel[dof] @ directions)
    return data


def _bodies(model: mujoco.MjModel, start: mujoco.MjData, controls: np.ndarray, steps: int) -> tuple[np.ndarray, int]:
    """Positions and rotation matrices ``[T, nbody, 3, 4]`` of all bodies, and the number of contacts met."""
    data, found, touched = copy.copy(start), [], 0
    for control in controls:
        data.ctrl[:] = control
        mujoco.mj_step(model, data, steps)
        mujoco.mj_forward(model, data)
        touched += data.ncon
        found.append(np.concatenate((data.xmat.reshape(-1, 3, 3), data.xpos[..., None]), axis=-1))
    return np.array(found), touched


def _differ(
    model: mujoco.MjModel, axis: int, pivot: ArrayLike = 0.0, shift: ArrayLike = 0.0, *, before: int = 0, steps: int = 5
) -> tuple[float, int]:
    """How far bodies come apart, metres and rotation matrices, in 20 steps if their start is rotated and shifted."""
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_WARMSTART)
    rng = np.random.default_rng(0)
    start = mujoco.MjData(model)
    mujoco.mj_integratePos(model, start.qpos, rng.uniform(-0.3, 0.3, model.nv), 1.0)
    start.qvel[:] = rng.uniform(-1, 1, model.nv)
    mujoco.mj_step(model, start, before)
    controls = rng.uniform(-1, 1, (20, model.nu))
    angle, place, shift = 0.7, np.broadcast_to(pivot, 3), np.broadcast_to(shift, 3)
    states, touched = _bodies(model, start, controls, steps)
    rotated, _ = _bodies(model, _rotate(model, start, axis, angle, place, shift), controls, steps)
    matrix = quaternion.to_matrix(quaternion.exp(angle * torch.eye(3, dtype=torch.float64)[axis])).view(3, 3).numpy()
    states[..., 3] -= place
    states = matrix @ states
    states[..., 3] += place + shift
    return float(np.abs(states - rotated)[:, topology(model).node_of_body > 0].max()), touched


@pytest.mark.parametrize("case", [case for case, (_, exact) in FREE_ROOTS.items() if exact])
def test_rotated_and_shifted_free_roots_move_alike(case):
    model = mujoco.MjModel.from_xml_string(FREE_ROOTS[case][0])
    frame = _frame(model)
    assert frame is not None
    scene = load_scene(FREE_ROOTS[case][0])
    shift = 3.0 * scene.translation_invariant
    assert (frame.axis is None) == ("without weight" in case)
    differences = [_differ(model, axis, frame.pivot, shift, before=60) for axis in frame.axes]
    error, touched = map(max, zip(*differences, strict=True))
    assert error < 1e-9
    assert touched or "floor" not in case and "ice" not in case and "ceiling" not in case
    pivots = "ball" in case.split(",")[0] and "slides" not in case or "turntable" in case
    np.testing.assert_allclose(frame.pivot[:2], [0.2, 0.1] if pivots else 0)


@pytest.mark.parametrize(
    "case", [case for case, (_, exact) in FREE_ROOTS.items() if not exact and "turntables" not in case]
)
def test_other_free_roots_move_differently_when_rotated(case):
    """The yaw frame is not exact beside a wall, or with friction pyramids, whose edges the world fixes."""
    model = mujoco.MjModel.from_xml_string(FREE_ROOTS[case][0])
    assert max(_differ(model, 2, before=before)[0] for before in (0, 60, 120)) > 1e-5


def test_the_heaviest_tree_gives_the_yaw():
    for density, heaviest in ((100, "b"), (1e6, "object")):
        light = _OBJECT.replace("<geom", f'<geom density="{density}"')
        scene = load_scene(_scene(FREE, world=light))
        assert scene.yaw_frame is not None and scene.node_names[scene.yaw_frame.node] == heaviest


_SITES = """<mujoco><worldbody><site name="fixed"/>
  <body name="b"><freejoint/><site name="thruster"/><site name="slider"/><geom size=".1"/></body></worldbody>
  <actuator><general {}/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("transmission", "invariant"),
    [
        ('site="thruster" gear="1 2 3 0 0 1"', True),
        ('site="thruster" refsite="slider" gear="1 0 0 0 0 0"', True),
        ('site="thruster" refsite="fixed" gear="1 0 0 0 0 0"', False),
        ('cranksite="thruster" slidersite="slider" cranklength="1"', True),
        ('cranksite="thruster" slidersite="fixed" cranklength="1"', False),
        ('body="b"', True),
    ],
)
def test_actuators_on_sites(transmission, invariant):
    model = mujoco.MjModel.from_xml_string(_SITES.format(transmission))
    assert (_frame(model) is not None) == invariant
    graph, data = topology(model), mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    assert translation_invariant(model, data, graph).any() == invariant


def _suite(name: str, cone: str = "elliptic") -> mujoco.MjModel:
    """A model of the Control Suite on flat ground, with its own motors."""
    folder = Path(pytest.importorskip("dm_control.suite").__file__).parent
    spec = mujoco.MjSpec.from_file(str(folder / f"{name}.xml"))
    spec.option.cone = getattr(mujoco.mjtCone, f"mjCONE_{cone.upper()}")
    for geom in list(spec.geoms):
        if geom.name == "terrain" or geom.name.startswith("wall"):
            spec.delete(geom)
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    return spec.compile()


@pytest.mark.parametrize(
    ("name", "exact"),
    [
        ("quadruped", True),
        ("humanoid", True),
        ("fish", True),
        ("swimmer", True),
        ("hopper", None),
        ("walker", None),
    ],
)
def test_rotated_robots_of_the_suite(name, exact):
    model = _suite(name)
    frame = _frame(model)
    assert (None if frame is None else frame.exact) == exact
    if frame is None:
        return
    assert frame.axis == (None if name == "fish" else 2) and not frame.pivot.any()
    for axis in frame.axes:
        error, touched = _differ(model, axis, shift=np.array([3.0, -2, 0]), before=100)
        assert error < 1e-9
    assert touched or name in ("fish", "swimmer")


@pytest.mark.parametrize("name", ["quadruped", "humanoid"])
def test_friction_pyramids_show_the_yaw(name):
    """MuJoCo's default: friction is up to 1.4 times as large along the pyramid's edges, which the world fixes."""
    model = _suite(name, "pyramidal")
    frame = _frame(model)
    assert frame is not None and not frame.exact
    assert max(_differ(model, 2, before=before)[0] for before in (100, 300, 500)) > 1e-6


@pytest.mark.skipif(not hasattr(mujoco.MjModel, "geom_surfacevel"), reason="MuJoCo before 3.11 moves no surfaces")
@pytest.mark.parametrize(
    ("surface", "exact", "shifts"),
    [("0 0 0 0 0 0", True, True), ("1 0 0 0 0 0", False, True), ("0 0 0 0 0 2", False, False)],
)
def test_surfaces_that_move_themselves(surface, exact, shifts):
    """A conveyor shows the yaw, a turntable where the scene is, too."""
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option cone="elliptic"/><worldbody>
      <geom type="plane" size="5 5 .1" surfacevel="{surface}"/>
      <body pos="0 0 .1"><freejoint/><geom type="box" size=".1 .1 .1"/></body></worldbody></mujoco>""")
    frame = _frame(model)
    assert frame is not None and frame.exact == exact
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    assert translation_invariant(model, data, topology(model)).tolist() == [shifts, shifts, False]

    def displacement(angle: float, *place: float) -> np.ndarray:
        """Return the box's displacement within half a second, in the box's start frame."""
        mujoco.mj_resetData(model, data)
        data.qpos[:] = *place, 0.1, np.cos(angle / 2), 0, 0, np.sin(angle / 2)
        mujoco.mj_step(model, data, 250)
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        return turn @ (data.qpos[:2] - place)

    here, turned, shifted = displacement(0.0, 0.5, 0.0), displacement(0.7, 0.5, 0.0), displacement(0.0, 1.0, -2.0)
    assert (np.abs(turned - here).max() < 1e-9) == exact
    assert (np.abs(shifted - here).max() < 1e-9) == shifts
