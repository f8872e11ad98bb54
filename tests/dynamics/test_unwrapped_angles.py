"""Joints that may make whole turns, where forces depend on these: their angle is state, as MuJoCo counts it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torchrl_gn.data import collect_trajectories, random_controls, sample_start_states
from torchrl_gn.data.simulate import Simulator
from torchrl_gn.dynamics import ForwardModel, MujocoPhysics, specialize
from torchrl_gn.dynamics.joint_coordinates import JointCoordinates
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.evaluation import evaluate_errors
from torchrl_gn.planners import ILQGPlanner
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import fit

from .. import zoo
from ..sizes import SMALL

# A servo of an endless joint, limits at two turns, and a joint that nothing holds.
TURNING = """<mujoco><option timestep="0.004"><flag contact="disable"/></option><worldbody>
  <body pos="0 0 1"><joint name="endless" axis="0 0 1" damping=".3" armature=".05"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/>
    <body pos=".3 0 0"><joint name="wide" axis="1 0 0" range="-720 720" limited="true" damping=".2" armature=".05"/>
      <geom type="capsule" fromto="0 0 0 .2 .1 0" size=".03"/>
      <body pos=".2 .1 0"><joint name="free" axis="0 1 0" damping=".1" armature=".02"/>
        <geom type="capsule" fromto="0 0 0 .1 0 .1" size=".02"/></body></body></body></worldbody>
  <actuator><position name="endless" joint="endless" kp="6" ctrlrange="-12 12" forcerange="-9 9"/>
    <motor name="wide" joint="wide" ctrlrange="-1 1"/><motor name="free" joint="free" ctrlrange="-.3 .3"/></actuator>
</mujoco>"""


@pytest.fixture(scope="module")
def scene():
    return load_scene(TURNING)


@pytest.fixture(scope="module")
def data(scene):
    return collect_trajectories(scene, 60, steps=60, seed=0, pace="full")


def angles(scene, physics):
    return physics[..., 1 + torch.as_tensor(scene.model.jnt_qposadr[scene.unwrapped.joint])]


def held(scene, state):
    return state[..., scene.unwrapped.node, scene.state_size - scene.unwrapped.size + scene.unwrapped.slot]


@pytest.mark.parametrize("name", ["pendulum", "cartpole", "acrobot", "swimmer6", "cheetah", "walker2d", "jaco"])
def test_the_papers_systems_hold_none(name):
    assert zoo.load(name).state_size == 13


def test_what_depends_on_whole_turns_is_state(scene):
    assert [scene.joint_names[joint] for joint in scene.unwrapped.joint] == ["endless", "wide"]
    assert scene.state_size == 14 and scene.layout.names[-1] == "unwrapped_angle"
    sprung = load_scene(TURNING.replace('<joint name="free"', '<joint name="free" stiffness=".1"'))
    assert len(sprung.unwrapped.joint) == 3
    off = load_scene(TURNING.replace('contact="disable"', 'contact="disable" limit="disable"'))
    assert len(off.unwrapped.joint) == 1
    wrist = zoo.load("gripper")  # a fixed tendon's servo pulls at it
    assert [wrist.joint_names[joint] for joint in wrist.unwrapped.joint] == ["wrist"]


def test_whole_turns_that_a_plugin_unwinds_are_state():
    """Two poses that look the same, one of them a turn away from the target, have different next states."""
    pid = """<mujoco><extension><plugin plugin="mujoco.pid"><instance name="pid"><config key="kp" value="4"/></instance>
      </plugin></extension>
      <worldbody><body><joint name="x" axis="0 1 0"/><geom size=".1" pos=".2 0 0"/></body></worldbody>
      <actuator><plugin joint="x" plugin="mujoco.pid" instance="pid" ctrlrange="-9 9"/></actuator></mujoco>"""
    scene = load_scene(pid)
    physics = torch.zeros(2, scene.physics_size, dtype=torch.float64)
    physics[1, 1] = 2 * math.pi
    state = Simulator(scene, 1).rollout(physics, torch.zeros(2, 1, 1, dtype=torch.float64))["state"]
    assert (state[0, 1, :, :13] - state[1, 1, :, :13]).abs().max() > 1e-3
    torch.testing.assert_close(state[0, 0, :, :13], state[1, 0, :, :13].abs())  # a quaternion has either sign
    assert held(scene, state[:, 0]).flatten().tolist() == [0, 2 * math.pi]


@pytest.mark.parametrize("limit", [160, 175, 180])
def test_a_hinge_beyond_a_limit_of_about_half_a_turn_is_not_at_the_other_limit(limit):
    """Limits are soft: gravity and speed press the hinge beyond them."""
    scene = load_scene(
        f"""<mujoco><worldbody><body><joint name="x" axis="0 1 0" range="-{limit} {limit}"/>
        <geom size=".1" pos=".2 0 0"/></body></worldbody>
        <actuator><position joint="x" kp="4" inheritrange="1"/></actuator></mujoco>"""
    )
    angle = math.radians(limit) + 0.2
    state = Simulator(scene, 1).observe(torch.tensor([[0.0, sign * angle, 0.0] for sign in (1, -1)]).double())
    position, _ = JointCoordinates(scene)(state)
    np.testing.assert_allclose(position[:, 0], [angle, -angle], atol=1e-6)


def test_states_show_the_simulations_angles(scene, data):
    assert torch.equal(held(scene, data["state"]), angles(scene, data["physics"]))
    assert data["physics"][..., 1].abs().max() > 2 * math.pi < data["physics"][..., 2].abs().max()
    position, _ = JointCoordinates(scene)(data["state"])
    close = (position - data["physics"][..., 1:4]).abs()
    assert close[..., :2].max() < 1e-9  # the third is the nearest to its reference


def test_bodies_correct_angles_that_are_nearly_right(scene, data):
    state = data["state"][:, 30].clone()
    state[..., 13] += (
        3 * (2 * torch.rand(state.shape[:2], dtype=torch.float64) - 1) * torch.from_numpy(scene.movable[:, 12])
    )
    position, _ = JointCoordinates(scene)(state)
    np.testing.assert_allclose(position[:, :2], data["physics"][:, 30, 1:3], atol=1e-9)


def test_predicted_angles_never_lose_a_turn(scene, data):
    """Along true bodies the law stays within half a turn, though whole ones pass."""
    bound = ForwardModel.for_scene(scene, **SMALL).bind(scene)
    assert not bound.movable[:, 12:].any() and scene.movable[:, 12].sum() == 2
    change = bound.delta(data["state"][:, :-1].flatten(0, 1), data["action"].flatten(0, 1))[..., 12:]
    moved = (data["state"][:, 1:] - data["state"][:, :-1])[..., 13:].flatten(0, 1)
    assert moved.abs().max() > 0.1 > (change - moved).abs().max()


@pytest.fixture(scope="module")
def trained(scene, data):
    model = ForwardModel.for_scene(scene, **SMALL)
    fit(model.bind(scene), data, steps=60, batch_size=64, seed=0, progress=False)
    return model


@pytest.mark.slow
def test_predictions_in_cpp_are_torchs(scene, data, trained):
    native, eager = (specialize(trained.bind(scene), executor=name) for name in ("native", "eager"))
    assert native.reason is None
    found, moves = [], torch.as_tensor(scene.movable[:, 6:12])  # velocities
    for predictor in (native, eager):
        state = data["state"][:5, 4].clone().requires_grad_()
        actions = data["action"][:5, 4:12].clone().requires_grad_()
        states = predictor.rollout(state, actions)[0]
        gradients = torch.autograd.grad(states[:, -1, :, 7:13].square().sum(), (state, actions))
        found.append((states.detach(), gradients[0][..., 7:13][:, moves], gradients[1]))
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_a_servo_far_from_its_target_is_learned(scene, data):
    """The same bodies a turn apart are pushed either way: without the turns no model can tell which."""
    torch.manual_seed(0)
    model = ForwardModel.for_scene(scene, hidden=32).bind(scene)
    more = collect_trajectories(scene, 300, steps=60, seed=1, pace="full")
    fit(model, more, steps=600, batch_size=128, seed=0, progress=False)
    table = evaluate_errors(model, data, horizons=[20])
    assert table["one_step_error"].total < 0.02 and table["rollout_error_20"].total < 0.05
    assert "unwrapped_angle" not in table["rollout_error_20"].components


def test_starts_and_targets_go_anywhere(scene):
    simulator = Simulator(load_scene(TURNING, wide_starts=1.0), 1)
    physics = sample_start_states(simulator.scene, 200, 0)
    assert np.ptp(physics[:, 2]) > 6 * np.pi
    controls = random_controls(simulator, physics, 100, 0, pace="fast")
    assert np.ptp(controls[..., 0]) > 20


def test_mujoco_as_physics_takes_them_along(scene, data):
    physics = MujocoPhysics(scene, num_threads=1)
    state, expected = data["state"][:, 30].clone(), data["state"][:, 31].clone()
    unknown = 3  # whose turns nothing depends on
    found = physics(state, data["action"][:, 30])
    torch.testing.assert_close(found[:, :unknown], expected[:, :unknown], rtol=0, atol=1e-9)


def reward(state, action, next_state, task):
    return next_state[..., 3, 2:3] - 1e-3 * action.square().sum(-1, keepdim=True)


@pytest.mark.slow
@pytest.mark.parametrize("learned", [False, True])
def test_ilqg_plans_with_them(scene, trained, learned):
    env = ModelEnv(trained.bind(scene), reward, seed=0) if learned else SceneEnv(scene, reward, seed=0)
    start = SceneEnv(scene, seed=0).reset()
    plan = ILQGPlanner(env, horizon=8, iterations=3).plan(start.select("state") if learned else start)
    assert plan.shape == (8, 3) and plan.isfinite().all() and plan.abs().max() > 0


# The middle one of three hinges reaches gimbal lock if it may turn by about 90 degrees.
SHOULDER = """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="a" axis="{}" stiffness="2"/>
  <joint name="b" axis="0 1 0" range="-{limit} {limit}" damping=".2"/><joint name="c" axis="1 0 0" armature=".1"/>
  <geom size=".1" pos=".2 .1 0"/></body></worldbody><actuator><motor joint="b" ctrlrange="-1 1"/></actuator></mujoco>"""


@pytest.mark.parametrize("axis", ["0 0 1", "0.5 -0.3 0.7"])
def test_three_hinges_are_told_apart_from_their_mirror_image_beyond_gimbal_lock(axis):
    """Poses beyond gimbal lock look like others before it, where springs, motors and limits act otherwise."""
    narrow, scene = (load_scene(SHOULDER.format(axis, limit=limit)) for limit in (30, 170))
    assert narrow.unwrapped.joint.tolist() == [0]  # its spring counts whole turns
    assert scene.unwrapped.joint.tolist() == [0, 1, 2]
    rng = np.random.default_rng(0)
    physics = np.zeros((200, 7))
    physics[:, 1:4] = rng.uniform([-8, -3.1, -8], [8, 3.1, 8], (200, 3))
    physics[:, 4:] = rng.normal(size=(200, 3))
    physics = torch.from_numpy(physics)
    position, velocity = JointCoordinates(scene)(Simulator(scene, 1).observe(physics))
    torch.testing.assert_close(position, physics[:, 1:4], rtol=0, atol=1e-6)
    torch.testing.assert_close(velocity, physics[:, 4:], rtol=0, atol=1e-4)


def test_known_physics_follow_three_hinges_through_gimbal_lock():
    scene = load_scene(SHOULDER.format("0 0 1", limit=170))
    physics = torch.tensor([[0, 0.4, 1.4, -0.3, 0.5, 6.0, -0.2]], dtype=torch.float64)
    action = torch.full((1, 10, 1), 0.5, dtype=torch.float64)
    truth = Simulator(scene, 1).rollout(physics, action)
    assert truth["physics"][0, -1, 2] > 2  # well beyond a quarter turn
    known, state = MujocoPhysics(scene, num_threads=1), truth["state"][:, 0]
    for each in action.unbind(1):
        state = known(state, each)
    torch.testing.assert_close(state, truth["state"][:, -1], rtol=0, atol=1e-6)


@pytest.mark.slow
def test_three_hinges_in_cpp_are_torchs():
    scene = load_scene(SHOULDER.format("0 0 1", limit=170))
    data = collect_trajectories(scene, 20, steps=20, seed=0)
    model = ForwardModel.for_scene(scene, **SMALL)
    fit(model.bind(scene), data, steps=5, batch_size=32, seed=0, progress=False)
    state, action = data["state"][:, 7], data["action"][:, 7]
    native, eager = (specialize(model.bind(scene), executor=name) for name in ("native", "eager"))
    assert native.reason is None and (held(scene, state)[:, 1].abs() > 1.7).any()
    torch.testing.assert_close(native.step(state, action)[0], eager.step(state, action)[0], rtol=1e-4, atol=1e-5)
