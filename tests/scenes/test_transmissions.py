"""Actuators through tendons, sites, slider-cranks and bodies, several at one edge, without bounds; constraints."""

from __future__ import annotations

import json
from typing import Any

import mujoco
import numpy as np
import pytest

from torchrl_gn.data import Simulator, collect_trajectories, sample_start_states, spline_controls
from torchrl_gn.scenes import Scene, SceneError, UnsupportedSceneError, load_scene, scene_from_description
from torchrl_gn.scenes.control_bounds import require_bounds
from torchrl_gn.scenes.systems.system import model_file

from .. import zoo

pytestmark = pytest.mark.filterwarnings("ignore::torchrl_gn.data.start_poses.StartPoseWarning")

SCENES = ("quadrotor", "gripper", "tendon_arm", "machine")
BOUNDED = {"action_bounds": (-1.0, 1.0)}


def _actions(scene: Scene) -> dict[tuple[str, str], list[str]]:
    """Names of the actuators at each pair, by its name and kind."""
    slots = scene.edge_action[::2].tolist()
    return {
        (pair.name, pair.kind): [scene.actuator_names[action] for action in actions if action >= 0]
        for pair, actions in zip(scene.pairs, slots, strict=True)
    }


def _gear(scene: Scene, pair: int, slot: int) -> np.ndarray:
    suffix = f"/{slot}" if slot else ""
    columns = [scene.static.edge_names.index(f"actuator_gear[{index}]{suffix}") for index in range(6)]
    return scene.static.edges[2 * pair, columns]


def _at_random_state(scene: Scene) -> mujoco.MjData:
    data = mujoco.MjData(scene.model)
    physics = sample_start_states(scene, 1, 0)[0]
    mujoco.mj_setState(scene.model, data, physics, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    mujoco.mj_forward(scene.model, data)
    return data


def _moment(scene: Scene, data: mujoco.MjData, actuator: int) -> np.ndarray:
    """Generalised forces ``[nv]`` of a unit of an actuator's force."""
    dense = np.zeros((scene.model.nu, scene.model.nv))
    mujoco.mju_sparse2dense(dense, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    return dense[actuator]


def test_actuators_act_at_the_edges_of_what_they_move():
    assert _actions(zoo.load("quadrotor")) == {("flight", "free"): ["front", "left", "back", "right"]}
    assert _actions(zoo.load("gripper")) == {
        ("wrist", "hinge"): ["roll"],
        ("thumb", "hinge"): ["grasp"],
        ("finger", "hinge"): ["grasp", "roll"],
    }
    assert _actions(zoo.load("tendon_arm")) == {
        ("rail", "slide"): ["pull"],
        ("shoulder", "hinge"): ["flex", "turn"],
        ("elbow", "hinge"): ["pull", "flex"],
    }
    assert _actions(zoo.load("machine")) == {
        ("crank", "hinge"): ["turn", "brake", "drive"],
        ("rod", "hinge"): ["free"],
        ("rocker", "ball"): ["swing"],
        ("piston", "slide"): ["drive", "servo"],
        ("joint4", "slide"): ["stick"],
        ("joint5", "slide"): [],
        ("aim", "site"): ["aim"],
        ("loop", "connect"): [],
    }


@pytest.mark.parametrize("name", SCENES)
def test_pairs_are_opposite_edges_and_joints_come_first(name):
    scene = zoo.load(name)
    assert tuple(pair.name for pair in scene.pairs if pair.element == "joint") == scene.joint_names
    assert [pair.element == "joint" for pair in scene.pairs[: len(scene.joint_names)]] == [True] * scene.model.njnt
    ends = [(pair.first, pair.second) for pair in scene.pairs]
    assert list(zip(scene.senders[::2], scene.receivers[::2], strict=True)) == ends
    assert list(zip(scene.receivers[1::2], scene.senders[1::2], strict=True)) == ends
    np.testing.assert_array_equal(scene.edge_action[::2], scene.edge_action[1::2])
    assert scene.static.edges.shape == (scene.num_edges, len(scene.static.edge_names))
    assert len(set(scene.static.edge_names)) == len(scene.static.edge_names)


def test_site_gears_are_wrenches_about_the_node():
    scene = zoo.load("quadrotor")
    data = _at_random_state(scene)
    body = int(scene.body[1])
    position, rotation = data.xpos[body], data.xmat[body].reshape(3, 3)
    jacobian = np.zeros((6, scene.model.nv))
    mujoco.mj_jac(scene.model, data, jacobian[:3], jacobian[3:], position, body)
    for slot in range(4):
        wrench = _gear(scene, 0, slot).reshape(2, 3) @ rotation.T
        np.testing.assert_allclose(jacobian.T @ wrench.ravel(), _moment(scene, data, slot), atol=1e-12)


def test_refsite_gears_are_wrenches_on_the_second_site_reversed():
    scene = zoo.load("machine")
    data, pair = _at_random_state(scene), [pair.name for pair in scene.pairs].index("aim")
    body, other = int(scene.body[scene.node_names.index("rocker")]), int(scene.body[scene.node_names.index("rod")])
    rotation = data.xmat[body].reshape(3, 3)
    force, torque = _gear(scene, pair, 0).reshape(2, 3) @ rotation.T
    top, end = data.site("top").xpos, data.site("end").xpos
    expected = np.zeros(scene.model.nv)
    couple = torque - np.cross(top - data.xpos[body], force)
    for sign, point, at in ((1, end, other), (-1, top, body)):
        mujoco.mj_applyFT(scene.model, data, sign * force, sign * couple, point, at, expected)
    np.testing.assert_allclose(expected, _moment(scene, data, scene.actuator_names.index("aim")), atol=1e-12)


@pytest.mark.parametrize("name", ["gripper", "machine"])
def test_gears_at_scalar_joints_are_moments(name):
    scene = zoo.load(name)
    data = _at_random_state(scene)
    for pair, actions in enumerate(scene.edge_action[::2]):
        if scene.pairs[pair].kind in ("hinge", "slide"):
            for slot, action in enumerate(actions):
                if action >= 0 and scene.actuator_names[action] not in ("stick", "drive"):
                    dof = scene.model.jnt_dofadr[pair]
                    assert _gear(scene, pair, slot)[0] == pytest.approx(_moment(scene, data, action)[dof])


def test_static_features_of_slots_transmissions_and_constraints():
    scene = zoo.load("machine")
    names, edges = scene.static.edge_names, scene.static.edges
    column = dict(zip(names, edges.T, strict=True))
    pendulum = load_scene("pendulum").static.edge_names
    assert names[: len(pendulum)] == pendulum
    np.testing.assert_array_equal(column["motorized"], scene.edge_action[:, 0] >= 0)
    np.testing.assert_array_equal(column["motorized/1"], scene.edge_action[:, 1] >= 0)
    assert column["actuator_gainprm[0]/1"][0] == 0.3 and column["actuator_ctrlrange[1]/1"][0] == 2
    kind = {"JOINT": 5, "SITE": 1, "SLIDERCRANK": 2, "BODY": 1}
    for name in mujoco.mjtTrn.__members__:
        name = name.removeprefix("mjTRN_")
        total = sum(column[f"actuator_trntype[{name}]{slot}"].sum() for slot in ("", "/1", "/2"))
        assert total == 2 * kind.get(name, 0), name
    loop = 2 * [pair.name for pair in scene.pairs].index("loop")
    assert np.flatnonzero(column["eq_type[CONNECT]"]).tolist() == [loop, loop + 1]
    data = mujoco.MjData(scene.model)
    mujoco.mj_kinematics(scene.model, data)
    points = []
    for end in ("first", "second"):
        body = int(scene.body[getattr(scene.pairs[loop // 2], end)])
        anchor = np.array([column[f"eq_{end}_anchor[{index}]"][loop] for index in range(3)])
        points.append(data.xpos[body] + data.xmat[body].reshape(3, 3) @ anchor)
    np.testing.assert_allclose(points[0], [0.5, 0, 1], atol=1e-12)
    np.testing.assert_allclose(points[0], points[1], atol=1e-12)


def test_two_motors_at_one_joint_keep_all_other_columns():
    one = zoo.load("two_links")
    motor = '<motor name="m" joint="a" ctrlrange="-1 2"/>'
    both = zoo.load("two_links", (motor, motor + '<velocity name="v" joint="a" kv="2" ctrlrange="-1 1"/>'))
    assert one.edge_action.tolist() == [[0], [0], [-1], [-1]]
    assert both.edge_action.tolist() == [[0, 1], [0, 1], [-1, -1], [-1, -1]]
    width = len(one.static.edge_names)
    assert both.static.edge_names[:width] == one.static.edge_names
    np.testing.assert_array_equal(both.static.edges[:, :width], one.static.edges)
    assert all(name.endswith("/1") for name in both.static.edge_names[width:])


@pytest.mark.parametrize("kind", ["connect", "weld"])
@pytest.mark.parametrize("sites", [False, True])
def test_anchors_of_constraints(kind, sites):
    text = f"""<mujoco><worldbody>
      <body name="a" pos="0 0 1"><freejoint/><geom size=".1"/><body name="tip" pos=".1 .2 0" quat=".9 .1 0 .2">
        <geom size=".05"/><site name="s" pos=".1 0 .2"/></body></body>
      <body name="b" pos="1 0 1" quat=".5 .4 .3 0"><freejoint/><geom size=".1"/><site name="t" pos="0 .3 0"/></body>
      </worldbody><equality><{kind} name="hold" {{}}/></equality></mujoco>"""
    ends = 'site1="s" site2="t"' if sites else 'body1="b" body2="tip" anchor=".1 0 .2"'
    scene = load_scene(text.format(ends))
    pair = scene.pairs[-1]
    assert (pair.name, pair.kind, pair.first, pair.second) == ("hold", kind, 1, 2)
    data = mujoco.MjData(scene.model)
    mujoco.mj_forward(scene.model, data)
    column = dict(zip(scene.static.edge_names, scene.static.edges[-1], strict=True))
    points = []
    for end, node in (("first", 1), ("second", 2)):
        body = int(scene.body[node])
        anchor = np.array([column[f"eq_{end}_anchor[{index}]"] for index in range(3)])
        points.append(data.xpos[body] + data.xmat[body].reshape(3, 3) @ anchor)
    gap = points[0] - points[1] if sites else np.zeros(3)
    np.testing.assert_allclose(points[0] - points[1], gap, atol=1e-9)
    if sites:
        np.testing.assert_allclose(points, [data.site("s").xpos, data.site("t").xpos], atol=1e-12)
    elif kind == "weld":
        np.testing.assert_allclose(
            points[0], data.body("tip").xpos + data.body("tip").xmat.reshape(3, 3) @ [0.1, 0, 0.2]
        )


def test_bounds_follow_from_forces_and_joints():
    scene = zoo.load("quadrotor", ('site="right" gear', 'site="right" gear'))
    assert (scene.action_low[3], scene.action_high[3]) == (0, 4)
    scene = zoo.load("machine")
    servo, free = scene.actuator_names.index("servo"), scene.actuator_names.index("free")
    assert (scene.action_low[servo], scene.action_high[servo]) == (-0.1, 0.1)
    assert (scene.action_low[free], scene.action_high[free]) == (-np.inf, np.inf)
    assert scene.unbounded == ("free",) and "no bounds: free" in str(scene) and "[-inf, inf]" in str(scene)
    # MuJoCo clamps at these bounds too, so that the simulation and the model agree beyond them.
    bounded = np.isfinite(scene.action_low)
    np.testing.assert_array_equal(scene.model.actuator_ctrlrange[bounded, 1], scene.action_high[bounded])
    np.testing.assert_array_equal(scene.model.actuator_ctrllimited, bounded)


def test_a_motor_reaches_its_force_limit_at_its_bounds():
    motor = '<general name="m" joint="a" gainprm="{}" forcelimited="true" forcerange="-1 6"/>'
    original = '<motor name="m" joint="a" ctrlrange="-1 2"/>'
    scene = zoo.load("two_links", (original, motor.format(2)))
    assert (scene.action_low[0], scene.action_high[0]) == (-0.5, 3)
    scene = zoo.load("two_links", (original, motor.format(-2)))
    assert (scene.action_low[0], scene.action_high[0]) == (-3, 0.5)


@pytest.mark.parametrize(
    ("actuator", "low", "high"),
    [
        ('<motor joint="a"/>', -6, 8),
        ('<motor joint="a" gear="2"/>', -3, 4),
        ('<general joint="a" gear="-2" gainprm="4"/>', -1, 0.75),
        ('<motor joint="a" forcerange="-1 2"/>', -1, 2),
        ('<motor joint="a" ctrlrange="-20 20"/>', -20, 20),
        ('<motor joint="b"/>', -np.inf, np.inf),
        ('<motor site="s" gear="0 0 0 0 1 0"/>', -np.inf, np.inf),
    ],
)
def test_a_motor_reaches_its_joints_force_limit_at_its_bounds(actuator, low, high):
    """As in files of Unitree's robots, whose motors have no ranges."""
    scene = load_scene(
        f"""<mujoco><worldbody><body><joint name="a" axis="0 1 0" actuatorfrcrange="-6 8"/><geom size=".1"/>
        <site name="s"/><body pos=".3 0 0"><joint name="b" axis="0 1 0"/><geom size=".1"/></body></body></worldbody>
        <actuator>{actuator}</actuator></mujoco>"""
    )
    assert (scene.action_low.tolist(), scene.action_high.tolist()) == ([low], [high])
    if np.isfinite(low) and "forcerange" not in actuator:
        data = mujoco.MjData(scene.model)
        for control in (low, high):
            data.ctrl[0] = control
            mujoco.mj_forward(scene.model, data)
            assert data.qfrc_actuator[0] in (-6, 8)


def test_a_servo_holds_its_joint_at_both_ends_of_its_range_at_its_bounds():
    scene = load_scene("""<mujoco><compiler angle="radian"/><worldbody><body>
      <joint name="a" range="-.5 1"/><geom size=".1"/></body></worldbody><actuator>
      <general joint="a" gear="2" gainprm="4" biastype="affine" biasprm="1 -2 0"/></actuator></mujoco>""")
    assert (scene.action_low.tolist(), scene.action_high.tolist()) == ([-0.75], [0.75])


@pytest.mark.parametrize("bounds", [(-2, 3), {"free": [-2, 3]}, {"free": (-2, 3), "turn": (-0.5, 0.25)}])
def test_action_bounds_are_part_of_the_description(bounds):
    text = zoo.mjcf("machine")
    scene = load_scene(text, action_bounds=bounds)
    free, turn = scene.actuator_names.index("free"), scene.actuator_names.index("turn")
    named = isinstance(bounds, dict) and "turn" in bounds
    assert (scene.action_low[free], scene.action_high[free]) == (-2, 3) and not scene.unbounded
    assert (scene.action_low[turn], scene.action_high[turn]) == ((-0.5, 0.25) if named else (-1, 1))
    again = scene_from_description(json.loads(json.dumps(scene.description())))
    assert again.fingerprint() == scene.fingerprint() != load_scene(text).fingerprint()
    np.testing.assert_array_equal(again.action_high, scene.action_high)
    assert np.isfinite(spline_controls(scene, 2, 5, 0)).all()


def test_bad_action_bounds_are_refused():
    text = zoo.mjcf("machine")
    wrong: list[Any] = [(1, -1), (0, np.inf), (1,), {"free": (2, 2)}, "ab"]
    for bounds in wrong:
        with pytest.raises(ValueError, match="two finite numbers, low then high"):
            load_scene(text, action_bounds=bounds)
    with pytest.raises(ValueError, match=r"\['motor'\], which are none of the actuators \['turn'"):
        load_scene(text, action_bounds={"motor": (-1, 1)})
    with pytest.raises(ValueError, match="bounds of its own"):
        load_scene("pendulum", action_bounds=(-1, 1))


def test_random_actions_without_bounds_are_refused_by_name():
    scene = zoo.load("machine")
    with pytest.raises(SceneError, match=r"Actions \['free'\] of scene 'machine' have no bounds.*action_bounds"):
        collect_trajectories(scene, 2, 3)
    rollout = Simulator(scene).rollout(sample_start_states(scene, 2, 0), np.full((2, 3, 8), 0.05))
    assert rollout["stable"].all() and rollout["state"].isfinite().all()


def test_idle_actuators_and_mocap_bodies_are_printed():
    site = ('site="front" gear', 'site="post" gear')
    scene = zoo.load("quadrotor", site, ('<body name="drone"', '<site name="post"/><body name="drone"'))
    assert 0 not in scene.edge_action and "actuators that move nothing: front" in str(scene)
    scene = zoo.load("machine")
    assert "target" not in scene.node_names and scene.attachments["target"].node == 0
    assert "mocap bodies, fixed at the pose of the model: target" in str(scene)
    assert "tendons that pull at joints: rope (hinge)" in str(zoo.load("everything"))
    assert "constraints without features: equality0" in str(zoo.load("soft"))


def test_invariance_of_sites_and_tendons():
    assert zoo.load("quadrotor").translation_invariant.tolist() == [True, True, False]
    reference = ('site="front" gear', 'site="front" refsite="post" gear')
    fixed = zoo.load("quadrotor", reference, ('<body name="drone"', '<site name="post"/><body name="drone"'))
    assert not fixed.translation_invariant.any()
    assert _actions(fixed) == {("flight", "free"): ["front", "left", "back", "right"]}


@pytest.mark.parametrize(("domain", "controls"), [("fish", 1), ("point_mass", 2), ("manipulator", 1), ("stacker", 1)])
def test_suite_domains_with_tendons_load(domain, controls):
    scene = load_scene(model_file(f"suite/{domain}.xml"))
    assert scene.edge_action.shape == (scene.num_edges, controls)
    assert set(range(scene.num_actions)) <= set(scene.edge_action.ravel().tolist())
    require_bounds(scene)


@pytest.mark.slow
@pytest.mark.parametrize(("domain", "count"), [("quadruped", 12), ("dog", 38)])
def test_suite_domains_with_activations_load(domain, count):
    scene = load_scene(model_file(f"suite/{domain}.xml"))
    held = scene.activations
    assert len(held.actuator) == scene.model.na == count and held.known.all()
    places = set(zip(held.node.tolist(), held.slot.tolist(), strict=True))
    assert len(places) == count and not {0} & set(held.node.tolist())
    assert {component.name: component.size for component in scene.layout.components}["activation"] == held.size
    # Each is held by a node that its actuator moves.
    for actuator, node in zip(held.actuator.tolist(), held.node.tolist(), strict=True):
        assert node in scene.receivers[(scene.edge_action == actuator).any(1)]


def test_adhesion_of_fixed_bodies_is_refused():
    with pytest.raises(UnsupportedSceneError, match="'stick'.*fixed to the world"):
        zoo.load("machine", ('body="pad"', 'body="target"'))


@pytest.mark.parametrize(
    ("name", "edit"),
    [
        ("quadrotor", ('name="front" pos="0.14', 'name="front" pos="0.15')),
        ("quadrotor", ('site="front" gear', 'site="left" gear')),
        ("gripper", ('joint="thumb" coef="0.5"', 'joint="thumb" coef="0.4"')),
        ("gripper", ('name="grasp" tendon="close"', 'name="grasp" tendon="roll"')),
        ("machine", ('cranklength="0.8"', 'cranklength="0.7"')),
        ("machine", ('site="end" refsite="top"', 'site="end" refsite="slider"')),
        ("machine", ('cranksite="knee"', 'cranksite="end"')),
        ("machine", ('<adhesion name="stick" body="pad"', '<adhesion name="stick" body="rod"')),
    ],
)
def test_fingerprints_tell_transmissions_apart(name, edit):
    assert zoo.load(name, edit).fingerprint() != zoo.load(name).fingerprint()


def test_numbers_beyond_float32_are_refused():
    with pytest.raises(
        SceneError, match=r"mass of body 'pad' in scene 'machine' is .*e\+99; give finite numbers below"
    ):
        zoo.load("machine", ('<geom type="sphere" size="0.06"/>', '<geom type="sphere" size="0.06" mass="1e99"/>'))
