"""Features of joints and actuators against MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from torchrl_gn.data import collect_trajectories
from torchrl_gn.dynamics import Actuators, Canonicalizer, ForwardModel, Joints, Wrenches, specialize
from torchrl_gn.dynamics.activation_laws import ActivationLaws
from torchrl_gn.dynamics.features import StepInputs
from torchrl_gn.dynamics.features.controls import ControlInputs
from torchrl_gn.dynamics.joint_coordinates import JointCoordinates
from torchrl_gn.evaluation import evaluate_errors
from torchrl_gn.maths import quaternion
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.scenes import PhysicalParameters, Scene, load_scene
from torchrl_gn.training import fit

from .. import zoo
from ..sizes import SMALL

_KINDS = mujoco.mjtJoint
SCENES = ("cheetah", "jaco", "joints", "creature", "two_hinges", "machine", "limited_joints", "tendon_arm", "servos")


def poses(scene: Scene, count: int, *, beyond: float = 0.0, speed: float = 1.0):
    """MuJoCo's data and body states ``[N, 13]`` at random coordinates, ``beyond`` the limits by this share of them."""
    model, rng = scene.model, np.random.default_rng(0)
    data = mujoco.MjData(model)
    winding = scene.unwrapped.joint
    for _ in range(count):
        mujoco.mj_resetData(model, data)
        data.qvel[:] = speed * rng.normal(size=model.nv)
        for joint in range(model.njnt):
            at, kind, (low, high) = model.jnt_qposadr[joint], _KINDS(model.jnt_type[joint]), model.jnt_range[joint]
            turn = rng.normal(size=4)
            turn /= np.linalg.norm(turn)
            if kind == _KINDS.mjJNT_FREE:
                data.qpos[at : at + 7] = *rng.normal(size=3), *turn
            elif kind == _KINDS.mjJNT_BALL:
                data.qpos[at : at + 4] = turn
            elif joint in winding:
                middle, half = (low + high) / 2, (1 + beyond) * (high - low) / 2
                data.qpos[at] = rng.uniform(middle - half, middle + half) if high > low else rng.uniform(-9, 9)
            elif model.jnt_limited[joint]:
                middle, half = (low + high) / 2, (1 + beyond) * min((high - low) / 2, 1.4)
                data.qpos[at] = rng.uniform(middle - half, middle + half)
            else:
                data.qpos[at] = model.qpos0[at] + rng.uniform(-1.4, 1.4)
        data.act[:] = rng.uniform(size=model.na)
        data.ctrl[:] = rng.uniform(scene.action_low.clip(-5), scene.action_high.clip(max=5))
        mujoco.mj_forward(model, data)
        physics = np.concatenate((np.zeros(1), data.qpos, data.qvel, data.act))
        yield data, torch.from_numpy(scene.states(data.sensordata.copy(), physics))


def inputs_of(scene: Scene, state, control) -> StepInputs:
    parameters = PhysicalParameters.of(scene)
    canonical = Canonicalizer(recenter=False, yaw=False).bind(scene, scene.layout)(state, parameters)
    if scene.model.na:
        held = torch.as_tensor(control)
        canonical = canonical._replace(activations=ActivationLaws(scene)(state, held, held))
    return StepInputs(canonical, ControlInputs(scene)(torch.as_tensor(control)), parameters)


def check_gradients(scene, kinds, action, weights, *, count: int, tolerance: float) -> None:
    """Weighted sums of features have finite gradients at rest, and the gradients of differences in ``count`` poses."""

    def total(state):
        given = inputs_of(scene, state, action)
        return torch.stack([(each * weights[: each.shape[-1]]).sum() for each in (kind(given) for kind in kinds)]).sum()

    data = mujoco.MjData(scene.model)
    mujoco.mj_forward(scene.model, data)
    rest = torch.from_numpy(scene.reference_state).requires_grad_()
    assert torch.autograd.grad(total(rest), rest)[0].isfinite().all()
    for _, state in poses(scene, count):
        change = torch.randn(scene.num_nodes, 12, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        zero = torch.zeros((), dtype=torch.float64, requires_grad=True)

        def step(size, state=state, change=change):
            return total(torch.cat((BODY_STATE.apply(state[:, :13], size * change), state[:, 13:]), dim=-1))

        assert torch.autograd.gradcheck(step, zero, atol=tolerance, rtol=tolerance)


def bind(feature, scene: Scene):
    return feature.resolved(scene).bind(scene, scene.layout, Canonicalizer().bind(scene, scene.layout))


ANCHORED = """<mujoco><worldbody><body pos=".3 0 1" euler="10 20 30">
  <joint name="x" type="slide" axis="1 .2 0" pos=".1 0 .2"/><joint name="y" type="slide" axis="0 1 .1" ref=".1"/>
  <joint name="a" axis="0 1 0" pos=".1 -.2 .3" ref="20"/><joint name="b" axis="1 .3 0" pos=".1 -.2 .3"/>
  <geom size=".1"/>
  <body pos="0 .4 0" euler="0 50 0"><joint name="z" type="slide" axis="0 0 1" pos=".2 .1 0"/>
    <joint name="ball" type="ball" pos="0 .1 .2"/><geom size=".1"/>
    <body pos=".2 0 0"><joint name="c" pos=".1 0 .1"/><geom size=".1"/></body></body></body></worldbody></mujoco>"""


@pytest.mark.parametrize("name", [*SCENES, "anchored"])
def test_coordinates_and_rates_are_mujocos(name):
    scene = load_scene(ANCHORED) if name == "anchored" else zoo.load(name)
    coordinates = JointCoordinates(scene)
    for data, state in poses(scene, 10):
        position, velocity = (each.numpy() for each in coordinates(state))
        for joint in range(scene.model.njnt):  # a quaternion has either sign
            at = scene.model.jnt_qposadr[joint] + 3 * (scene.model.jnt_type[joint] == int(_KINDS.mjJNT_FREE))
            if scene.model.jnt_type[joint] in (int(_KINDS.mjJNT_FREE), int(_KINDS.mjJNT_BALL)):
                position[at : at + 4] *= np.sign(position[at : at + 4] @ data.qpos[at : at + 4])
        np.testing.assert_allclose(position, data.qpos, atol=1e-9)
        np.testing.assert_allclose(velocity, data.qvel, atol=1e-8)


def test_joints_that_do_not_follow_from_their_body_have_no_features():
    scene = zoo.load("parallel_hinges")
    coordinates = JointCoordinates(scene, partly=True)
    assert coordinates.known.tolist() == [True, False, False]
    state = next(poses(scene, 1))[1]
    features = bind(Joints(), scene)(inputs_of(scene, state, np.zeros(scene.num_actions)))
    assert not features[2:].any() and features[:2].any()


@pytest.mark.skipif(not hasattr(mujoco.MjModel, "jnt_stiffnesspoly"), reason="MuJoCo before 3.7")
@pytest.mark.parametrize(("stiffness", "shown"), [("0", 0), ("5", 1), ("0 5", 1)])
def test_coordinates_of_springs_are_shown_also_of_those_without_a_linear_part(stiffness, shown):
    scene = load_scene(
        f"""<mujoco><worldbody><body><joint type="slide" axis="1 0 0" ref=".3" stiffness="{stiffness}"/>
        <geom size=".1"/></body></worldbody></mujoco>"""
    )
    for data, state in poses(scene, 3):
        coordinate = bind(Joints(), scene)(inputs_of(scene, state, data.ctrl))[0, 2]
        np.testing.assert_allclose(coordinate, shown * data.qpos[0], atol=1e-12)


@pytest.mark.parametrize("name", [*SCENES, "walker2d"])
def test_limits_set_in_where_mujocos_do(name):
    scene = zoo.load(name)
    feature, model, found = bind(Joints(), scene), scene.model, 0
    for data, state in poses(scene, 20, beyond=0.3):
        features = feature(inputs_of(scene, state, data.ctrl)).unflatten(0, (-1, 2))
        torch.testing.assert_close(features[:, 0], features[:, 1])
        within = (features[:, 0, 4:6] >= 0).all(-1)
        active = data.efc_id[data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT)]
        expected = torch.ones(model.njnt, dtype=torch.bool)
        expected[active.astype(int)] = False
        assert torch.equal(within, expected)
        found += len(active)
    assert found or not model.jnt_limited.any()


def test_the_step_on_and_the_friction():
    scene = zoo.load("servos")
    feature = bind(Joints(), scene)
    near, compared = torch.tensor([0.1, 0.1, 0.1, 0.1, 0.02], dtype=torch.float64), 0
    for _, state in poses(scene, 30, speed=0.01):
        features = feature(inputs_of(scene, state, np.zeros(6)))[::2]
        moved = scene.timestep * features[:, 3] / near
        for now, sign in ((4, 1), (5, -1)):
            free = (features[:, [now, now + 2]].abs() < 0.99).all(-1) & (features[:, now] != 0)
            torch.testing.assert_close((features[:, now + 2] - features[:, now])[free], sign * moved[free])
            compared += int(free.sum())
    assert compared > 10
    assert features[:, 8].nonzero().flatten().tolist() == [3]
    torch.testing.assert_close(features[3, 8], (features[3, 3] / 0.05).clamp(-1, 1))


@pytest.mark.parametrize("name", ["servos", "jaco", "gripper", "arm", "activated", "activated with RK4"])
def test_forces_are_mujocos(name):
    """The sum over an edge's actuators is ``qfrc_actuator``."""
    if name == "activated with RK4":  # forces with actearly use Euler's next activation, not that of the next step
        early, rk4 = ('name="slow"', 'name="slow" actearly="true"'), ('"0.002"', '"0.002" integrator="RK4"')
        scene = zoo.load("activated", early, rk4)
    else:
        scene = zoo.load(name)
    feature = bind(Actuators(), scene)
    slots = scene.edge_action.shape[1]
    for data, state in poses(scene, 20):
        features = feature(inputs_of(scene, state, data.ctrl)).unflatten(-1, (slots, 4))
        force = features[: 2 * scene.model.njnt : 2, :, 0].sum(-1).numpy()
        np.testing.assert_allclose(force, data.qfrc_actuator[scene.model.jnt_dofadr], atol=1e-8)


SWITCHED_OFF = (
    ("<option", '<option actuatorgroupdisable="2"'),
    ("<flag", '<flag actuation="disable"'),
)
TWO_GROUPS = """<mujoco><option timestep="0.002"><flag/></option><worldbody>
  <body><joint name="a" axis="0 1 0"/><geom size=".1" pos=".3 0 0"/><site name="tip" pos=".3 0 0"/>
    <body pos=".3 0 0"><joint name="b" axis="0 1 0"/><geom size=".1" pos=".3 0 0"/></body></body></worldbody>
  <tendon><spatial name="line"><site site="base"/><site site="tip"/></spatial></tendon>
  <actuator><position name="servo" joint="a" kp="9" group="2" ctrlrange="-1 1"/>
    <motor name="motor" joint="a" group="1" ctrlrange="-1 1"/>
    <position name="pull" tendon="line" kp="7" group="2" ctrlrange="0 1"/>
    <muscle name="muscle" joint="b" group="2" lengthrange="-1 1"/>
    <general name="both" joint="b" biastype="affine" biasprm="1 2 3" ctrlrange="-1 1"/>
    <motor name="jet" site="tip" gear="1 2 3 0 0 0" group="2" ctrlrange="-1 1"/></actuator></mujoco>""".replace(
    "<worldbody>", '<worldbody><site name="base" pos="0 0 1"/>'
)


@pytest.mark.parametrize("edit", SWITCHED_OFF)
def test_actuators_that_are_switched_off_have_no_force(edit):
    scene = load_scene(TWO_GROUPS.replace(*edit))
    off = scene.actuator_names if "flag" in edit[0] else ("servo", "pull", "muscle", "jet")
    assert f"switched off: {', '.join(off)}" in str(scene)
    feature, wrenches, slots = bind(Actuators(), scene), bind(Wrenches(), scene), scene.edge_action.shape[1]
    for data, state in poses(scene, 5):
        given = inputs_of(scene, state, data.ctrl)
        features = feature(given).unflatten(-1, (slots, 4))
        np.testing.assert_allclose(features[:4:2, :, 0].sum(-1), data.qfrc_actuator, atol=1e-9)
        assert not wrenches(given).any()
        of_them = np.isin(scene.edge_action, [scene.actuator_names.index(name) for name in off])
        assert not features[torch.from_numpy(of_them)].any()


def test_a_servos_error_and_its_force_a_step_on():
    scene = zoo.load("servos")
    feature, finger = bind(Actuators(), scene), scene.actuator_names.index("finger")
    data, state = next(poses(scene, 1, speed=0.1))
    slot = scene.edge_action[8].tolist().index(finger)
    for offset in (0.001, -0.003, 0.02):
        position, rate = data.qpos[4], data.qvel[4]
        control = data.ctrl.copy()
        control[finger] = np.clip(position + 10 / 400 * rate + offset, 0, 0.04)
        error = control[finger] - position - 10 / 400 * rate
        found = feature(inputs_of(scene, state, control))[8].unflatten(-1, (-1, 4))[slot]
        expected = [400 * error, 400 * (error - scene.timestep * rate)]
        expected += [np.clip(error / near, -1, 1) for near in (0.05, 0.005)]
        np.testing.assert_allclose(found, expected, atol=1e-9)


def test_scenes_that_actuators_suit():
    suits = {"servos": True, "jaco": True, "swimmer6": False, "cheetah": False, "falling": False}
    for name, expected in suits.items():
        scene = zoo.load(name)
        assert Actuators.suits(scene) == expected, name
        kinds = [type(each) for each in ForwardModel.for_scene(scene, **SMALL).features]
        assert (Actuators in kinds) == expected and Joints in kinds


@pytest.mark.parametrize("name", ["servos", "joints", "creature", "limited_joints"])
def test_gradients_are_finite_at_rest_and_right_elsewhere(name):
    scene = zoo.load(name)
    kinds = [bind(Joints(), scene), bind(Actuators(), scene)]
    weights = torch.linspace(-1, 1, 400, dtype=torch.float64)

    def total(state, control):
        given = inputs_of(scene, state, control)
        return sum((each * weights[: each.shape[-1]]).sum() for each in (kind(given) for kind in kinds))

    data = mujoco.MjData(scene.model)
    mujoco.mj_forward(scene.model, data)
    rest = torch.from_numpy(scene.reference_state).requires_grad_()
    control = torch.zeros(scene.num_actions, dtype=torch.float64, requires_grad=True)
    for gradient in torch.autograd.grad(total(rest, control), (rest, control), allow_unused=True):
        assert gradient is None or gradient.isfinite().all()
    for _, state in poses(scene, 3):
        change = torch.randn(scene.num_nodes, 12, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

        def along(step, state=state, change=change):
            moved = torch.cat((BODY_STATE.apply(state[:, :13], step * change), state[:, 13:]), dim=-1)
            return total(moved, control.detach())

        zero = torch.zeros((), dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(along, zero, atol=1e-4, rtol=1e-4)


def test_variants_bring_their_own_joints_and_laws(random_states, random_actions):
    """Samples that bring a variant's numbers get the features of that variant's scene."""
    from torchrl_gn.scenes.variants import sample_variants

    for name in ("cheetah", "jaco", "swimmer6"):
        scene = zoo.load(name)
        for variant in sample_variants(name, 2, 0):
            own, there = PhysicalParameters.of(scene), PhysicalParameters.of(variant)
            assert not torch.equal(own.joint_pose, there.joint_pose) or not torch.equal(own.actuator, there.actuator)
            state, action = random_states(scene, 4), random_actions(scene, 4)
            for feature in (Joints(), Actuators()):
                here, expected = bind(feature, scene), bind(feature, variant)
                given = inputs_of(variant, state, action)
                torch.testing.assert_close(here(given), expected(given), rtol=0, atol=1e-12)


@pytest.mark.slow
def test_batches_of_any_shape_and_the_native_step(fit, random_states, random_actions):
    scene = zoo.load("servos")
    torch.manual_seed(0)
    model = fit(ForwardModel.for_scene(scene, **SMALL), scene)
    assert {Joints, Actuators} <= {type(each) for each in model.features}
    state, action = random_states(scene, 2, 3), random_actions(scene, 2, 3)
    predictor = specialize(model.bind(scene), executor="native")
    expected = model.bind(scene, reference=True).step(state, action)[0]
    torch.testing.assert_close(predictor.step(state, action)[0], expected, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_a_stiff_servo_arm_is_learned_from_slow_targets():
    """The case of the SO-101 arm: without its servos' forces the error stays above 1, the error of standing still."""
    scene = zoo.load("servo_arm")
    torch.manual_seed(0)
    model = ForwardModel.for_scene(scene, hidden=64).bind(scene)
    fit(model, collect_trajectories(scene, 200, seed=0), steps=300, progress=False)
    errors = evaluate_errors(model, collect_trajectories(scene, 10, seed=1), horizons=(100,))
    assert errors["rollout_error_100"].total < 0.3


def test_orientations_of_either_sign_give_the_same(random_states):
    scene = zoo.load("servos")
    state = random_states(scene, 3)
    at = BODY_STATE.slices["orientation"]
    turned = torch.cat((state[..., : at.start], -state[..., at], state[..., at.stop :]), dim=-1)
    assert quaternion.angle(turned[..., at], state[..., at]).max() < 1e-12
    for feature in (bind(Joints(), scene), bind(Actuators(), scene)):
        torch.testing.assert_close(
            feature(inputs_of(scene, turned, torch.zeros(3, 6))), feature(inputs_of(scene, state, torch.zeros(3, 6)))
        )


@pytest.mark.parametrize("by_actuator", ["false", "true"])
def test_a_joints_limit_is_on_the_force_with_gravity_compensation(by_actuator):
    scene = load_scene(
        f"""<mujoco><worldbody><body gravcomp="1"><joint name="a" axis="0 1 0" actuatorfrcrange="-3 3"
          actuatorgravcomp="{by_actuator}"/><geom type="capsule" fromto="0 0 0 1 0 0" size=".05" mass="1"/></body>
        </worldbody><actuator><position joint="a" kp="10" ctrlrange="-2 2"/></actuator></mujoco>"""
    )
    feature = bind(Actuators(), scene)
    for data, state in poses(scene, 10):
        own = 0.0 if by_actuator == "false" else data.qfrc_gravcomp[0]
        force = feature(inputs_of(scene, state, data.ctrl))[0, 0].item()
        assert np.clip(force + own, -3, 3) == pytest.approx(data.qfrc_actuator[0])


@pytest.mark.skipif(not hasattr(mujoco.MjModel, "actuator_ctrlnum"), reason="MuJoCo before 3.11 turns the long way")
@pytest.mark.parametrize("gear", ["0 0 0 0 1 0", "0 0 0 0 -2 0", "1 0 0 0 1 0"])
def test_a_servo_of_a_sites_orientation_turns_the_short_way(gear):
    """The target may be more than half a turn away; a gear that also moves the site has no short way."""
    scene = load_scene(
        f"""<mujoco><worldbody><site name="still"/><body><joint axis="0 1 0"/><geom size=".1"/><site name="s"/></body>
        </worldbody><actuator><position site="s" refsite="still" gear="{gear}" kp="2" ctrlrange="-9 9"/></actuator>
        </mujoco>"""
    )
    data, actuators = mujoco.MjData(scene.model), bind(Actuators(), scene)
    for angle in (-3, -1, 0.5, 2.5):
        for target in (-9, -4, 0, 2, 5, 8):
            data.qpos[0], data.ctrl[0] = angle, target
            mujoco.mj_forward(scene.model, data)
            state = torch.from_numpy(scene.states(data.sensordata, np.zeros(scene.physics_size)))
            force = actuators(inputs_of(scene, state, data.ctrl))[0, 0]
            np.testing.assert_allclose(force, data.actuator_force[0], atol=1e-9)


@pytest.mark.skipif(not hasattr(mujoco.mjtGain, "mjGAIN_PID"), reason="MuJoCo before 3.12")
def test_a_pid_controller_of_a_position_without_state_is_a_position_servo():
    arm = """<mujoco><worldbody><body><joint name="x" axis="0 1 0" range="-60 60"/><geom size=".1" pos=".2 0 0"/></body>
      </worldbody><actuator><{} joint="x" kp="40" dampratio="1" forcerange="-3 3"/></actuator></mujoco>"""
    pid, position = load_scene(arm.format('pid input="pos"')), load_scene(arm.format("position"))
    assert pid.fingerprint() == position.fingerprint() and not pid.unbounded
    assert Actuators.suits(pid)
    raw = mujoco.MjModel.from_xml_string(arm.format('pid input="pos"'))
    forces = []
    for model in (raw, pid.model):
        data = mujoco.MjData(model)
        data.qpos[0], data.qvel[0], data.ctrl[0] = 0.3, -0.5, 0.35
        mujoco.mj_forward(model, data)
        forces.append(data.actuator_force[0])
    assert forces[0] == forces[1] != 0
    integrating = load_scene(arm.format('pid input="pos" ki="5" ctrlrange="-1 1"'))
    assert integrating.model.na == 1 and integrating.model.actuator_gaintype[0] == int(mujoco.mjtGain.mjGAIN_PID)


DRIVEN = """<mujoco><option integrator="implicitfast"/><worldbody><body><joint name="x" axis="0 1 0" range="-60 60"/>
  <geom size=".1" pos=".2 0 0"/></body></worldbody><actuator><{} joint="x" ctrlrange="-4 4"/></actuator></mujoco>"""
DC = 'dcmotor motorconst=".5 .6" resistance="2"'


@pytest.mark.skipif(not hasattr(mujoco.mjtGain, "mjGAIN_PID"), reason="MuJoCo before 3.12")
@pytest.mark.parametrize(
    "actuator",
    [
        *(f'pid kp="5" kv="1" input="{kind}"' for kind in ("vel", "ff")),
        *(f'{DC} controller="3 0 .1" input="{kind}"' for kind in ("pos", "vel", "ff")),
        *(DC, f'{DC} gear="20" armature=".1" damping="1"', f'{DC} saturation="1 0 0"'),
    ],
)
def test_controllers_and_dc_motors_without_state_have_their_force(actuator):
    text = DRIVEN.format(actuator)
    scene, raw = load_scene(text), mujoco.MjModel.from_xml_string(text)
    feature, own = bind(Actuators(), scene), mujoco.MjData(raw)
    assert "without features" not in str(scene)
    for data, state in poses(scene, 5):
        own.qpos[:], own.qvel[:], own.ctrl[:] = data.qpos, data.qvel, data.ctrl
        mujoco.mj_forward(raw, own)
        force = feature(inputs_of(scene, state, data.ctrl))[0, 0]
        np.testing.assert_allclose(force, own.qfrc_actuator[0], atol=1e-9)
        for model, each in ((raw, own), (scene.model, data)):
            mujoco.mj_step(model, each, 10)
        np.testing.assert_allclose(data.qpos, own.qpos, atol=1e-9)


@pytest.mark.skipif(not hasattr(mujoco.mjtGain, "mjGAIN_PID"), reason="MuJoCo before 3.12")
@pytest.mark.parametrize(
    "actuator",
    [
        *('pid kp="5" ki="1" input="pos"', 'pid kp="5" slewmax="1" input="pos"', f'{DC} inductance=".01"'),
        *(f'{DC} cogging=".1 6 0"', f'{DC} lugre="1 2 3 4 5"', f'{DC} controller="3 1 .1" input="pos"'),
    ],
)
def test_controllers_and_dc_motors_with_state_are_named(actuator):
    scene = load_scene(DRIVEN.format(actuator))
    assert "actuators without features of their forces: actuator0" in str(scene)
    data, state = next(poses(scene, 1))
    assert not bind(Actuators(), scene)(inputs_of(scene, state, data.ctrl)).any()


@pytest.mark.parametrize("thruster", ["", '<motor site="end" gear="0 0 5 0 0 0" ctrlrange="-1 1"/>'])
def test_a_joints_limit_is_on_the_total_of_its_motor_and_a_thruster(thruster):
    """The feature shows the motor's own force where the thruster's part of the total is unknown."""
    scene = load_scene(
        f"""<mujoco><worldbody><body><joint name="a" axis="0 1 0" actuatorfrcrange="-1 1"/>
          <geom size=".1" pos=".2 0 0"/><body pos=".3 0 0"><joint axis="0 1 0"/><geom size=".1" pos=".2 0 0"/>
          <site name="end" pos=".2 0 0"/></body></body></worldbody>
        <actuator><motor joint="a" gear="5" ctrlrange="-1 1"/>{thruster}</actuator></mujoco>"""
    )
    for data, state in poses(scene, 10):
        force = bind(Actuators(), scene)(inputs_of(scene, state, data.ctrl)).reshape(-1, 4)[0, 0]
        expected = data.actuator_force[0] * 5 if thruster else data.qfrc_actuator[0]
        np.testing.assert_allclose(force, expected, atol=1e-9)
