"""Random controls by actuator kind and pace: scaled, reversing, around the current pose, against gravity."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest

from torchrl_gn.data import Simulator, actuator_kind, has_paces, random_controls, sample_start_states, spline_controls
from torchrl_gn.data.holding import MotorLaws, pose_holding_controls
from torchrl_gn.scenes import SceneError, load_scene

ARM = """
<mujoco model="arm">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body pos="0 0 1"><joint name="a" axis="0 0 1" damping="1" range="-170 170"/>
      <geom type="capsule" size=".05" fromto="0 0 0 .4 0 0"/>
      <body pos=".4 0 0"><joint name="b" axis="0 1 0" damping="1" range="-120 120"/>
        <geom type="capsule" size=".04" fromto="0 0 0 .3 0 0"/>
        <body pos=".3 0 0"><joint name="c" type="slide" axis="1 0 0" range="0 .2"/><geom size=".03"/>
          <body><joint name="d" axis="1 0 0" damping=".1"/><geom size=".03" pos="0 0 .1"/></body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="a" joint="a" kp="200" kv="20" ctrlrange="-2.9 2.9"/>
    <general name="b" joint="b" gear="2" gainprm="300" biastype="affine" biasprm="60 -100 -10" ctrlrange="-1 1"/>
    <velocity name="c" joint="c" kv="50" ctrlrange="-.3 .2"/>
    <general name="d" joint="d" gainprm="2" biastype="affine" biasprm="0 0 -1" ctrlrange="-1 3"/>
  </actuator>
  <keyframe><key name="home" qpos="1 -.5 .1 0" ctrl="0 0 0 1"/></keyframe>
</mujoco>
"""


def test_kinds() -> None:
    model = load_scene(ARM).model
    assert [actuator_kind(model, actuator) for actuator in range(4)] == ["position", "position", "velocity", "motor"]
    assert {actuator_kind(load_scene("jaco").model, actuator) for actuator in range(9)} == {"velocity"}
    assert actuator_kind(load_scene("cheetah").model, 0) == "motor"


@pytest.fixture(scope="module")
def drawn() -> tuple[Simulator, np.ndarray, np.ndarray]:
    simulator = Simulator(load_scene(ARM), 1)
    physics = sample_start_states(simulator.scene, 300, 0)
    return simulator, physics, random_controls(simulator, physics, 200, 0, pace="calm")


def test_position_targets_hold_the_start_and_move_slowly(drawn) -> None:
    simulator, physics, controls = drawn
    scene = simulator.scene
    assert controls.shape == (300, 200, 4) and controls.dtype == np.float64
    assert (controls >= scene.action_low).all() and (controls <= scene.action_high).all()
    qpos = physics[:, 1:3]
    # Force: 200 (u - q), and 300 u + 60 - 100 (2 q).
    start = np.clip(np.stack([qpos[:, 0], (200 * qpos[:, 1] - 60) / 300], -1), [-2.9, -1], [2.9, 1])
    np.testing.assert_allclose(controls[:, 0, :2], start, atol=1e-12)
    speed = abs(np.diff(controls[..., :2], axis=1)).max(1) / scene.timestep
    limit = np.array([np.pi, 2.0])  # pi rad/s of the joint, and the width of the bounds a second
    assert (speed <= 1.0001 * limit).all() and (speed.max(0) > 0.6 * limit).all()
    assert (speed.mean(0) < 0.5 * limit).all()
    reach = np.ptp(controls[..., :2], axis=1)
    assert (reach.max(0) > 0.5 * np.array([5.8, 2])).all() and (reach.min(0) < 0.1 * np.array([5.8, 2])).all()


def test_a_quarter_of_the_calm_sequences_holds_its_state(drawn) -> None:
    _, _, controls = drawn
    still = (np.ptp(controls[..., :2], axis=1) <= 0.02 * np.array([5.8, 2]) + 1e-12).all(1)
    assert 0.15 < still.mean() < 0.35


def test_calm_fast_and_full_sequences_make_the_mixture(drawn) -> None:
    simulator, physics, calm = drawn
    drawings = {pace: random_controls(simulator, physics, 200, 0, pace=pace) for pace in ("fast", "mixed", "full")}
    for other in drawings.values():
        np.testing.assert_array_equal(other[..., 2:], calm[..., 2:])  # the others keep the speed limits at full bounds
    speeds = {name: abs(np.diff(each[..., :2], axis=1)).max(1) for name, each in {**drawings, "calm": calm}.items()}
    median = {name: np.median(each, axis=0) for name, each in speeds.items()}
    assert (2.5 * median["calm"] < median["fast"]).all() and (1.5 * median["fast"] < median["full"]).all()
    quick = (speeds["mixed"] > 1.0001 * speeds["calm"].max(0)).any(1)
    assert 0.15 < quick.mean() < 0.35
    with pytest.raises(ValueError, match=r"pace='slow' is not known; use one of \['mixed', 'calm', 'fast', 'full'\]"):
        random_controls(simulator, physics, 2, 0, pace="slow")  # pyright: ignore[reportArgumentType]


def test_servos_follow_without_flinging_the_arm(drawn) -> None:
    simulator, physics, _ = drawn
    physics, speed = physics[:40], {}
    for pace in ("calm", "fast", "full"):
        moved = simulator.rollout(physics, random_controls(simulator, physics, 60, 0, pace=pace))
        assert moved["stable"].all()
        speed[pace] = moved["physics"][..., 5 + 1 : 5 + 2 + 1].abs()
    assert max(speed["calm"].max(), speed["fast"].max()) < 8 and speed["full"].max() > 20
    calm, fast, full = (float(each.flatten().quantile(0.95)) for each in speed.values())
    assert 1.8 * calm < fast < 2 * np.pi and 1.5 * fast < full


def test_velocity_targets_reverse(drawn) -> None:
    _, _, controls = drawn
    target = controls[..., 2]
    assert target.min() > -0.3 - 1e-12 and target.max() < 0.2 + 1e-12
    sides = np.sign(target)
    reversals = (sides[:, 1:] != sides[:, :-1]).sum(1)
    assert (reversals >= 2).mean() > 0.97 and 4 < np.median(reversals) < 20
    assert abs(target).max(1).min() < 0.1 and abs(target).max(1).max() > 0.28


def test_motors_are_scaled_towards_the_keyframe(drawn) -> None:
    _, _, controls = drawn
    span = np.ptp(controls[..., 3], axis=1)
    assert span.min() < 0.35 * 4 and span.max() > 0.9 * 4
    calm = controls[span < 1.2, :, 3]
    assert calm.min() > -0.2 and calm.max() < 2.0  # 1 +- 0.4


def test_one_way_velocity_servos_and_short_sequences() -> None:
    scene = load_scene(ARM.replace('ctrlrange="-.3 .2"', 'ctrlrange=".1 .2"'))
    simulator, physics = Simulator(scene, 1), sample_start_states(scene, 20, 0)
    controls = random_controls(simulator, physics, 50, 0)[..., 2]
    assert controls.min() >= 0.1 and controls.max() <= 0.2 and np.ptp(controls) > 0.05
    for steps in (0, 1, 2):
        assert np.isfinite(random_controls(simulator, physics, steps, 0)).all()
    with pytest.raises(ValueError, match="knot_interval"):
        random_controls(simulator, physics, 3, 0, knot_interval=-1)


@pytest.mark.parametrize("name", ["jaco", "cheetah"])
def test_systems_of_the_paper_have_plain_splines(name: str) -> None:
    simulator = Simulator(load_scene(name), 1)
    controls = random_controls(simulator, sample_start_states(simulator.scene, 3, 0), 20, 7)
    np.testing.assert_array_equal(controls, spline_controls(simulator.scene, 3, 20, 7))


def test_each_variant_starts_from_its_own_pose() -> None:
    scenes = [
        load_scene(ARM),
        load_scene(ARM.replace('qpos="1 -.5', 'qpos="1 .5').replace('biasprm="60', 'biasprm="0')),
    ]
    simulator, variant = Simulator(scenes, 1), np.array([1, 0, 1])
    physics = np.concatenate([sample_start_states(scenes[which], 1, 0) for which in variant])
    controls = random_controls(simulator, physics, 5, 0, variant=variant)
    expected = (200 * physics[:, 2] - [0, 60, 0]) / 300
    np.testing.assert_allclose(controls[:, 0, 1], np.clip(expected, -1, 1), atol=1e-12)


def test_actions_without_bounds_are_named() -> None:
    scene = load_scene(ARM)
    scene = dataclasses.replace(scene, action_high=np.array([2.9, np.inf, 0.2, 3.0]))
    for draw in (
        lambda: random_controls(Simulator(scene, 1), sample_start_states(scene, 2, 0), 3, 0),
        lambda: spline_controls(scene, 2, 3, 0),
    ):
        with pytest.raises(SceneError, match=r"\['b'\] of scene 'arm' have no bounds .*action_bounds="):
            draw()


TORQUES = """
<mujoco model="torques">
  <option integrator="implicitfast"/><compiler autolimits="true"/>
  <default><joint damping=".5" armature=".05" range="-170 170"/><geom type="capsule" size=".04" mass="2"/></default>
  <worldbody>
    <body pos="0 0 1"><joint name="a" axis="0 0 1"/><geom fromto="0 0 0 0 0 .3"/>
      <body pos="0 0 .3"><joint name="b" axis="0 1 0"/><geom fromto="0 0 0 .4 0 0"/>
        <body pos=".4 0 0"><joint name="c" axis="0 1 0"/><geom fromto="0 0 0 .4 0 0"/>
          <body pos=".4 0 0"><joint name="d" axis="1 0 0"/><geom type="sphere" size=".03" pos=".05 0 .05" mass=".3"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="a" ctrlrange="-{0} {0}"/><motor joint="b" gear="2" ctrlrange="-{0} {0}"/>
    <motor joint="c" ctrlrange="-{0} {0}"/><motor joint="d" ctrlrange="-12 12"/>
  </actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def torques() -> tuple[Simulator, np.ndarray]:
    scene = load_scene(TORQUES.format(80))
    return Simulator(scene, 1), sample_start_states(scene, 40, 0)


@pytest.mark.slow
def test_motors_of_an_arm_that_full_torques_fling_follow_slow_paths_but_for_some(torques) -> None:
    simulator, physics = torques
    assert has_paces(simulator)
    speed = {}
    for pace in ("calm", "fast", "full", "mixed"):
        moved = simulator.rollout(physics, random_controls(simulator, physics, 30, 0, pace=pace))["physics"]
        speed[pace] = moved[..., 5:9].abs().amax((1, 2))
        if pace == "calm":
            assert (moved[..., 1:5].abs() > 2.96).double().mean() < 0.02
    assert float(speed["full"].median()) > 12 and float(speed["calm"].max()) < 1.5 * np.pi
    assert float(speed["calm"].median()) > 0.5
    assert 2 * speed["calm"].median() < speed["fast"].median() < 0.7 * speed["full"].median()
    assert 0.1 < float((speed["mixed"] > 1.5 * np.pi).double().mean()) < 0.45
    assert 0.02 < float((speed["mixed"] > speed["full"].median()).double().mean()) < 0.2


@pytest.mark.parametrize("through", ["joint", "tendon"])
def test_motors_take_the_inverse_dynamics(torques, through) -> None:
    simulator, physics = torques
    if through == "tendon":  # of b alone, and of b and c
        tendons = """<tendon><fixed name="own"><joint joint="b" coef="2"/></fixed>
          <fixed name="both"><joint joint="b" coef="1"/><joint joint="c" coef="1"/></fixed></tendon><actuator>"""
        text = TORQUES.format(80).replace("<actuator>", tendons)
        text = text.replace('joint="b" gear="2"', 'tendon="own"').replace('motor joint="c"', 'motor tendon="both"')
        simulator = Simulator(load_scene(text), 1)
    model, rng = simulator.scene.model, np.random.default_rng(0)
    data, laws = mujoco.MjData(model), MotorLaws(model)
    np.testing.assert_array_equal(laws.driven_joints(physics[0]), range(4))
    for state in physics[:10].copy():
        state[5:9], acceleration = rng.normal(size=4), rng.normal(size=4)
        data.qpos[:], data.qvel[:], data.qacc[:] = state[1:5], state[5:9], acceleration
        mujoco.mj_inverse(model, data)
        found = laws.controls(model, state, np.arange(4), acceleration)
        forces = found * [1, 2, 1, 1] + (through == "tendon") * np.array([0, found[2], 0, 0])
        np.testing.assert_allclose(forces, data.qfrc_inverse, atol=1e-9)
    holding = pose_holding_controls(simulator, physics[:20], np.zeros(20, dtype=int), np.zeros(4))
    moved = simulator.rollout(physics[:20], np.repeat(holding[:, None], 30, axis=1))
    assert moved["physics"][..., 5:9].abs().max() < 1e-6


def test_motors_that_cannot_move_each_joint_alone_get_bounded_splines() -> None:
    text = """<mujoco><worldbody><body><joint name="cart" type="slide" axis="1 0 0" range="-1 1" limited="true"/>
      <geom size=".1" mass="1"/><body><joint axis="0 1 0" damping="1"/><geom size=".05" pos="0 0 -.5"/></body></body>
      </worldbody><actuator><motor joint="cart" ctrlrange="-100 100"/></actuator></mujoco>"""
    simulator = Simulator(load_scene(text), 1)
    physics = sample_start_states(simulator.scene, 40, 0)
    assert MotorLaws(simulator.scene.model).driven_joints(physics[0]) is None
    calm, fast, full = (random_controls(simulator, physics, 40, 0, pace=pace) for pace in ("calm", "fast", "full"))
    np.testing.assert_array_equal(calm, fast)
    assert 1 < np.abs(calm).max() < 0.6 * np.abs(full).max()
    speed = [simulator.rollout(physics, each)["physics"][..., 3].abs().quantile(0.9) for each in (calm, full)]
    assert speed[0] < 2 and speed[1] > 3


def test_motors_that_cannot_hold_a_robot_keep_their_rest() -> None:
    """A cart that is pushed cannot hold its pole; the pole's own motor can."""
    text = """<mujoco><worldbody><body><joint name="cart" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/>
      <body><joint name="pole" axis="0 1 0"/><geom size=".1" mass="2" pos=".5 0 0"/></body></body></worldbody>
      <actuator><motor joint="{}" ctrlrange="-30 30"/></actuator>
      <keyframe><key name="home" ctrl="1"/></keyframe></mujoco>"""
    for joint, expected in (("cart", 0.25), ("pole", -2 * 9.81 * 0.5)):
        simulator = Simulator(load_scene(text.format(joint)), 1)
        physics = np.tile(sample_start_states(simulator.scene, 1, 0) * 0, (2, 1))
        holding = pose_holding_controls(simulator, physics, np.zeros(2, dtype=int), np.full(1, 0.25))
        np.testing.assert_allclose(holding, expected, rtol=1e-9)


def test_robots_that_move_sanely_at_full_bounds_have_one_pace() -> None:
    scene = load_scene(TORQUES.format(0.5).replace("-12 12", "-.05 .05"))
    simulator, physics = Simulator(scene, 1), sample_start_states(scene, 10, 0)
    assert not has_paces(simulator) and not has_paces(Simulator(load_scene("cheetah"), 1))
    drawn = [random_controls(simulator, physics, 20, 0, pace=pace) for pace in ("calm", "mixed", "full")]
    np.testing.assert_array_equal(drawn[0], drawn[2])
    np.testing.assert_array_equal(drawn[1], drawn[2])


HEAVY = {
    "a fixed tendon": ('<fixed armature=".5"><joint joint="j" coef="1"/><joint joint="k" coef="2"/></fixed>', ""),
    "a spatial tendon": ('<spatial armature="5"><site site="s"/><site site="t"/></spatial>', ""),
    "an actuator": ("", 'armature=".7"'),
}


@pytest.mark.parametrize("tendon, motor", HEAVY.values(), ids=HEAVY.keys())
def test_motors_also_accelerate_armatures_of_tendons_and_actuators(tendon, motor):
    text = f"""<mujoco><worldbody><body name="a" pos="0 0 1"><joint name="j" axis="0 1 0" armature=".1" damping=".3"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/><site name="s" pos=".1 0 .1"/><body name="b" pos=".3 0 0">
      <joint name="k" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/>
      <site name="t" pos=".1 0 .1"/>
      </body></body></worldbody><tendon>{tendon}</tendon><actuator><motor joint="j" ctrlrange="-1 1" {motor}/>
      <motor joint="k" ctrlrange="-1 1"/></actuator></mujoco>"""
    try:
        scene = load_scene(text)
    except SceneError as error:
        pytest.skip(f"this MuJoCo has no such armature: {error}")
    model, state, wanted = scene.model, scene.rest_physics.copy(), np.array([-3.0, 2.0])
    state[1:5] = 0.3, -0.8, 2.0, -1.0
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    model.actuator_ctrllimited[:] = 0
    data.ctrl[:] = MotorLaws(model).controls(model, state, np.arange(2), wanted)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qacc, wanted, rtol=1e-9)


COMPENSATED = """<mujoco><option{}/><worldbody><body pos="0 0 1" gravcomp="{}">
  <joint name="a" axis="0 1 0" actuatorgravcomp="{}"/><geom type="capsule" fromto="0 0 0 .5 0 0" size=".03" mass="1"/>
  </body></worldbody><actuator><motor name="a" joint="a" ctrlrange="-10 10"/>
  <motor name="other" joint="a" ctrlrange="-10 10" group="3"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("option", "share", "by_actuator", "controls"),
    [
        ("", 0, "false", [-1.22625, -1.22625]),
        ("", 1, "false", [0, 0]),
        ("", 1, "true", [0, 0]),
        ("", 0.5, "true", [-0.613125, -0.613125]),
        (' actuatorgroupdisable="3"', 0, "false", [-2.4525, 0]),
    ],
)
def test_motors_hold_a_pose_with_gravity_compensation_and_with_motors_off(option, share, by_actuator, controls) -> None:
    simulator = Simulator(load_scene(COMPENSATED.format(option, share, by_actuator)), 1)
    start = simulator.scene.rest_physics[None]
    held = pose_holding_controls(simulator, start, np.zeros(1, dtype=np.int64), np.zeros(2))
    np.testing.assert_allclose(held, [controls], atol=1e-9)
    moved = simulator.rollout(start, np.repeat(held[:, None], 10, axis=1))["physics"][0, -1, 1:3]
    np.testing.assert_allclose(moved, [0, 0], atol=1e-9)


@pytest.mark.parametrize("kind", ["hinge", "slide"])
def test_calm_motors_follow_paths_from_where_an_unlimited_joint_is(kind) -> None:
    text = """<mujoco><worldbody><body pos="0 0 1"><joint type="{}" axis="0 0 1" damping=".1"/>
      <geom type="capsule" fromto="0 0 0 .5 0 0" size=".03" mass="1"/></body></worldbody>
      <actuator><motor joint="joint0" ctrlrange="-200 200"/></actuator>
      <keyframe><key name="home" qpos="{}"/></keyframe></mujoco>"""
    found = []
    for at in (0.5, 0.5 + 4 * np.pi):
        simulator = Simulator(load_scene(text.format(kind, at).replace("<joint ", '<joint name="joint0" ')), 1)
        start = np.tile(simulator.scene.rest_physics, (8, 1))
        start[:, 1] = at
        found.append(random_controls(simulator, start, 60, 0, pace="calm"))
    np.testing.assert_allclose(*found, atol=1e-6)
    assert np.abs(found[1]).max() < 20


@pytest.mark.skipif(not hasattr(mujoco.mjtGain, "mjGAIN_PID"), reason="a later MuJoCo's actuator")
def test_servos_of_unknown_laws_are_driven_without_warnings(recwarn) -> None:
    scene = load_scene(ARM.replace('<position name="a"', '<pid input="pos" name="a"'))
    simulator = Simulator(scene, 1)
    controls = random_controls(simulator, sample_start_states(scene, 4, 0), 20, 0)
    assert np.isfinite(controls).all() and np.ptp(controls[..., 0]) > 0.1 and not len(recwarn)
