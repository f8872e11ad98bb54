"""Poses of mocap bodies as actions: simulation, data, inputs of the network, predictions and plans."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.data import collect_trajectories
from torchrl_gn.data.controls import spline_controls
from torchrl_gn.data.random_controls import random_controls
from torchrl_gn.data.simulate import Simulator
from torchrl_gn.data.start_states import draw_start_states
from torchrl_gn.dynamics import ForwardModel, MujocoPhysics, specialize
from torchrl_gn.dynamics.features import MocapPoses, StepInputs
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.evaluation import evaluate_errors
from torchrl_gn.maths import quaternion
from torchrl_gn.planners import GradientPlanner, ILQGPlanner, TerminalReward
from torchrl_gn.rewards.tasks import Effort
from torchrl_gn.scenes import Scene, load_scene, scene_from_description
from torchrl_gn.scenes.scene import SceneError, UnsupportedSceneError
from torchrl_gn.training import fit

from .. import zoo
from ..sizes import SMALL


@pytest.fixture(scope="module")
def led() -> Scene:
    return zoo.load("led_arm", mocap_actions=True)


@pytest.fixture(scope="module")
def data(led) -> TensorDict:
    return collect_trajectories(led, 20, steps=100, seed=0)


@pytest.fixture(scope="module")
def trained(led, data) -> ForwardModel:
    model = ForwardModel.for_scene(led, **SMALL)
    fit(model.bind(led), data, steps=30, batch_size=64, seed=0)
    return model


def test_actions_are_controls_then_poses(led):
    assert led.action_names == ("slide", *(f"mocap.{each}" for each in ("x", "y", "z", "qw", "qx", "qy", "qz")))
    assert led.num_actions == 8 and led.actuator_names == ("slide",)
    assert led.action_low[1:].tolist() == pytest.approx([0.3, -0.15, 0.45, -1, -1, -1, -1])
    assert not led.unbounded and "mocap" not in led.attachments
    bounded = zoo.load("led_arm", mocap_actions=True, action_bounds={"mocap.y": (-0.02, 0.3)})
    assert (bounded.action_low[2], bounded.action_high[2]) == (-0.02, 0.3)
    again = scene_from_description(bounded.description())
    assert again.action_names == led.action_names and again.action_high.tolist() == bounded.action_high.tolist()
    assert "poses of mocap bodies, actions: mocap.x" in str(led)


@pytest.mark.parametrize("pair", [(0.3, -0.02), (0.0, float("nan")), (0.0, 0.1, 0.2)])
@pytest.mark.parametrize("source", [zoo.mjcf, lambda name: mujoco.MjSpec.from_string(zoo.mjcf(name))])
def test_bounds_of_poses_are_two_numbers_in_order(source, pair):
    with pytest.raises(ValueError, match=r"action_bounds of mocap\.y must be two finite numbers"):
        load_scene(source("led_arm"), mocap_actions=True, action_bounds={"mocap.y": pair})


def test_by_default_they_stay_where_they_are():
    fixed = zoo.load("led_arm")
    assert fixed.num_actions == 1 and "mocap" in fixed.attachments


def test_scenes_without_are_refused():
    with pytest.raises(SceneError, match="No mocap body of scene 'two_links' leads"):
        zoo.load("two_links", mocap_actions=True)
    touching = '<geom size=".02" contype="0" conaffinity="0"/></body>', '<geom name="tip" size=".02"/></body>'
    solid = '<geom type="box" size=".01 .01 .03" contype="0" conaffinity="0"/>', '<geom type="box" size=".01 .01 .03"/>'
    with pytest.raises(UnsupportedSceneError, match="'tip'.*can touch moving bodies"):
        zoo.load("led_arm", touching, solid, mocap_actions=True)
    with pytest.raises(ValueError, match="mocap_actions goes with MJCF"):
        load_scene("pendulum", mocap_actions=True)


CARRIERS = """<mujoco><worldbody>
  <body name="lead" mocap="true" pos="0 0 1"><site name="eye"/>{kid}</body>
  <body name="hand" pos="0 0 1"><freejoint/><geom size=".1" contype="0" conaffinity="0"/><site name="tip" pos=".1 0 0"/>
  </body></worldbody><equality><weld body1="lead" body2="hand"/></equality>{rest}</mujoco>"""
LINE = '<tendon><spatial name="line" stiffness="9"><site site="eye"/><site site="tip"/></spatial></tendon>'
AIM = '<actuator><motor name="aim" site="tip" refsite="eye" gear="1 0 0 0 0 0" ctrlrange="-1 1"/></actuator>'


@pytest.mark.parametrize(
    ("carried", "given"),
    [
        ("body 'kid'", {"kid": '<body name="kid" pos=".2 0 0"><joint axis="0 1 0"/><geom size=".05"/></body>'}),
        ("tendon 'line'", {"rest": LINE}),
        ("actuator 'aim'", {"rest": AIM}),
    ],
)
def test_nothing_hangs_on_poses_that_are_actions(carried, given):
    """Joint coordinates and lengths would belong to the model's pose."""
    text = CARRIERS.format(**{"kid": "", "rest": ""} | given)
    assert load_scene(text).num_nodes == 2 + ("kid" in given)
    with pytest.raises(UnsupportedSceneError, match=f"carry {carried}"):
        load_scene(text, mocap_actions=True)
    assert load_scene(CARRIERS.format(kid="", rest=""), mocap_actions=True).num_actions == 7


@pytest.mark.parametrize("stretch", [1.0, 0.5])
def test_simulations_are_mujocos_with_the_pose_held(led, stretch):
    """A quaternion that is shorter, and a place beyond the bounds, which is at them."""
    simulator, rng = Simulator(led, 1), np.random.default_rng(0)
    start, _ = draw_start_states(simulator, np.zeros(1, dtype=np.int64), rng)
    actions = np.tile([0.01, 0.4, 0.1, 0.9, 0.9, 0.1, 0.2, 0.3], (1, 3, 1))
    actions[..., 4:] *= stretch
    found = simulator.rollout(start, actions)
    model, state = led.model, mujoco.MjData(led.model)
    mujoco.mj_setState(model, state, start[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)
    state.ctrl[0], state.mocap_pos[0] = 0.01, [0.4, 0.1, 0.75]
    state.mocap_quat[0] = np.array([0.9, 0.1, 0.2, 0.3]) / np.linalg.norm([0.9, 0.1, 0.2, 0.3])
    for _ in range(3 * led.substeps):
        mujoco.mj_step(model, state)
    np.testing.assert_allclose(found["physics"][0, -1, 1 : 1 + model.nq], state.qpos, atol=1e-12)
    after, shown = simulator.step(np.asarray(found["physics"][:, -2]), actions[:, -1])
    np.testing.assert_allclose(after, found["physics"][:, -1], atol=1e-12)
    np.testing.assert_allclose(shown, found["state"][:, -2], atol=1e-12)
    physics = MujocoPhysics(led, num_threads=1)
    one, other = physics(found["state"][:, 1], torch.from_numpy(actions[:, 1])), found["state"][:, 2]
    assert quaternion.angle(one[..., 3:7], other[..., 3:7]).max() < 1e-6
    torch.testing.assert_close(one[..., 7:], other[..., 7:], rtol=0, atol=1e-8)


def test_settling_keeps_the_models_pose(led):
    """An episode starts like the model whose mocap body stays."""
    start, _ = draw_start_states(Simulator(led, 1), np.zeros(2, dtype=np.int64), np.random.default_rng(0))
    moved, still = (Simulator(scene, 1).settle(start, 20)[0] for scene in (led, zoo.load("led_arm")))
    np.testing.assert_array_equal(moved, still)


def test_random_paths_are_smooth_bounded_and_by_pace(led):
    simulator = Simulator(led, 1)
    start, _ = draw_start_states(simulator, np.zeros(40, dtype=np.int64), np.random.default_rng(0))
    paths = {pace: random_controls(simulator, start, 100, 0, pace=pace) for pace in ("calm", "fast", "mixed", "full")}
    for found in paths.values():
        assert found.shape == (40, 100, 8)
        assert (found >= led.action_low - 1e-12).all() and (found <= led.action_high + 1e-12).all()
        np.testing.assert_allclose(np.linalg.norm(found[..., 4:], axis=-1), 1.0)
        np.testing.assert_allclose(found[:, 0, 1:], np.tile(led.mocaps.rest, (40, 1)), atol=1e-12)
        assert np.abs(np.diff(found[..., 1:4], axis=1)).max() <= 0.5 * led.timestep + 1e-9
    speed = {pace: np.abs(np.diff(found[..., 1:4], axis=1)).mean() for pace, found in paths.items()}
    assert speed["calm"] < speed["mixed"] < speed["fast"] and speed["fast"] > 2 * speed["calm"]


def test_bodies_follow(led, data):
    hand = led.node_names.index("hand")
    away = (data["state"][:, 1:, hand, :3] - data["action"][..., 1:4]).norm(dim=-1)
    assert away.mean() < 0.02 < data["state"][..., hand, :3].std((0, 1)).norm()


def test_the_feature_is_the_welds_violation(led, data):
    """The violation is at the action's pose, for the hand's present state and for its state a step later."""
    feature = MocapPoses().bind(led, led.layout, None)
    model, held, hand = led.model, mujoco.MjData(led.model), led.node_names.index("hand")
    state, action = data["state"][:, 50], data["action"][:, 70]
    bound = ForwardModel.for_scene(led, **SMALL).bind(led)
    canonical = bound.canonicalizer(state, bound.scene_parameters)
    found = feature(StepInputs(canonical, torch.empty(0), bound.scene_parameters, action))
    edges = np.flatnonzero(found.abs().sum((0, 2)) > 0)
    assert edges.tolist() == [led.num_edges - 2, led.num_edges - 1]
    torch.testing.assert_close(found[:, -2], found[:, -1])
    for row in range(len(state)):
        mujoco.mj_setState(model, held, data["physics"][row, 50].numpy(), mujoco.mjtState.mjSTATE_FULLPHYSICS)
        held.mocap_pos[0], held.mocap_quat[0] = action[row, 1:4].numpy(), action[row, 4:].numpy()
        mujoco.mj_forward(model, held)
        violation = held.efc_pos[held.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)]
        gap, turn = found[row, -1, :3], found[row, -1, 9:12]
        np.testing.assert_allclose(gap.abs().numpy(), np.abs(violation[:3]), atol=1e-9)
        # MuJoCo has half of twice the quaternion's vector, times the torque scale, in the body's frame.
        np.testing.assert_allclose(turn.norm() / 2 * 0.01, np.linalg.norm(violation[3:]), atol=1e-6)
    moved = gap - led.timestep * state[-1, hand, 7:10]
    torch.testing.assert_close(found[-1, -1, 6:9], moved)
    torch.testing.assert_close(found[-1, -1, 3:6], (gap / 0.01).clamp(-1, 1))


@pytest.mark.slow
def test_predictions_in_cpp_are_torchs_and_poses_have_gradients(led, data, trained):
    native, eager = (specialize(trained.bind(led), executor=name) for name in ("native", "eager"))
    assert native.reason is None
    found = []
    for predictor in (native, eager):
        actions = data["action"][:4, :5].clone().requires_grad_()
        states = predictor.rollout(data["state"][:4, 0], actions)[0]
        found.append((states.detach(), *torch.autograd.grad(states[:, -1].square().sum(), actions)))
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
    assert (found[0][1][..., 1:].abs().amax((0, 1)) > 0).all()
    longer = data["action"][:4, :5].clone()
    longer[..., 4:] *= 0.5
    torch.testing.assert_close(native.rollout(data["state"][:4, 0], longer)[0], found[0][0])


def reward(state, action, next_state, task):
    return -(next_state[..., 4, :3] - next_state.new_tensor([0.45, 0.05, 0.62])).norm(dim=-1, keepdim=True)


@pytest.mark.slow
def test_environments_and_planners_take_poses(led, data, trained):
    env, true = ModelEnv(trained.bind(led), reward, seed=0), SceneEnv(led, reward, seed=0)
    assert env.action_spec.shape == true.action_spec.shape == (8,)
    start = true.reset()
    plan = ILQGPlanner(true, horizon=5, iterations=3).plan(start)
    assert plan.shape == (5, 8) and plan.isfinite().all()
    entries = GradientPlanner(env, horizon=4, candidates=3, iterations=2)(start.select("state"))
    assert entries["action"].shape == (8,) and entries["action"].isfinite().all()


@pytest.mark.slow
def test_an_arm_that_is_led_is_learned(led):
    """Train for a short time. Training with other samples' actions gives an error of 1.5."""
    train, test = (collect_trajectories(led, count, seed=seed) for seed, count in enumerate((150, 30)))
    torch.manual_seed(0)
    model = ForwardModel.for_scene(led, hidden=64)
    fit(model.bind(led), train, steps=500, batch_size=200, seed=0)
    table = evaluate_errors(specialize(model.bind(led)), test, horizons=[20])
    assert table["rollout_error_20"].total < 0.2


def test_variants_with_other_mocap_poses_are_refused(led):
    other = zoo.load("led_arm", ('pos=".45 0 .6"', 'pos=".4 0 .6"'), mocap_actions=True)
    with pytest.raises(ValueError, match="action_low of scene 0"):
        Simulator([led, other])
    bound = ForwardModel.for_scene(led, **SMALL).bind(led, parameters_key="parameters")
    with pytest.raises(ValueError, match="mocap poses"):
        bound.parameters_of(other)


def test_rest_and_effort_of_poses(led):
    assert led.rest_action.tolist() == [0, 0.45, 0, 0.6, 1, 0, 0, 0]
    shown = []

    def asked(state, action, next_state, task):
        shown.append(action)
        return action[..., :1]

    TerminalReward(asked, led, 1.0)(torch.zeros(2, led.num_nodes, 13, dtype=torch.float64))
    torch.testing.assert_close(shown[0], torch.from_numpy(led.rest_action).expand(2, -1))
    action = torch.from_numpy(led.rest_action).expand(3, -1).clone()
    state = torch.zeros(3, led.num_nodes, 13)
    assert not Effort(led)(state, action, state).any()
    action[:, 0] = 0.03
    torch.testing.assert_close(Effort(led)(state, action, state), torch.full((3, 1), -1.0))
    drawn = spline_controls(led, 50, 30, 0)[..., 4:]
    assert (drawn[..., 0] > 0.5).all() and np.abs(drawn[..., 1:]).max() < 0.5
