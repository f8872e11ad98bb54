"""Activations of actuators as state: MuJoCo's laws, forces, the network's share, and everything that holds states."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.data import collect_trajectories
from torchrl_gn.data.simulate import Simulator
from torchrl_gn.data.start_states import draw_start_states
from torchrl_gn.dynamics import Canonicalizer, ForwardModel, MujocoPhysics, specialize
from torchrl_gn.dynamics.activation_laws import ActivationLaws
from torchrl_gn.dynamics.features import Activations
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.evaluation import evaluate_errors
from torchrl_gn.planners import ILQGPlanner
from torchrl_gn.policies import StateFeatures, StatePolicy
from torchrl_gn.policies.body_frame_features import BodyFrameFeatures
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import fit

from .. import zoo
from ..sizes import SMALL

INTEGRATORS = ("Euler", "implicitfast", "RK4")


def simulated(scene, count: int = 6, steps: int = 8, seed: int = 0):
    """States ``[count, steps + 1, N, C]`` with random activations at the start, and actions."""
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.as_tensor(scene.action_low), torch.as_tensor(scene.action_high)
    actions = low + (high - low) * torch.rand(count, steps, len(low), generator=generator, dtype=torch.float64)
    physics = torch.zeros(count, scene.physics_size, dtype=torch.float64)
    physics[:, 1 : 1 + scene.model.nq] = torch.from_numpy(scene.model.qpos0)
    physics[:, -scene.model.na :] = 0.7 * torch.rand(count, scene.model.na, generator=generator, dtype=torch.float64)
    return Simulator(scene, 1).rollout(physics, actions)["state"], actions


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_activations_follow_mujocos_laws(integrator):
    scene = zoo.load("activated", ('timestep="0.002"', f'timestep="0.002" integrator="{integrator}"'))
    bound = ForwardModel.for_scene(scene, **SMALL).bind(scene)
    states, actions = simulated(scene)
    change = bound.delta(states[:, :-1].flatten(0, 1), actions.flatten(0, 1))
    moved = states[:, 1:] - states[:, :-1]
    assert (moved[..., 13:].abs().amax((0, 1)) > 1e-3).sum() == scene.model.na
    torch.testing.assert_close(change[..., 12:], moved[..., 13:].flatten(0, 1), rtol=1e-10, atol=1e-12)
    assert not bound.movable[:, 12:].any() and scene.movable[:, 12:].sum() == scene.model.na


def test_a_muscle_contracts_as_mujoco_has_it():
    """``mju_muscleDynamics``, sharp and smooth."""
    scene = zoo.load("activated")
    laws = ActivationLaws(scene)
    muscles = laws.is_muscle.nonzero().flatten().tolist()
    widths = scene.model.actuator_dynprm[scene.activations.actuator[muscles], 2]
    assert widths.tolist() == [0.2, 0]
    for now in (0.0, 0.2, 0.7, 1.0):
        for control in (0.0, 0.15, 0.3, 0.8, 1.0):
            held = torch.full((scene.num_actions,), control, dtype=torch.float64)
            rate = laws._rate(torch.full((scene.model.na,), now, dtype=torch.float64), held[laws.control])
            for muscle in muscles:
                prm = scene.model.actuator_dynprm[scene.activations.actuator[muscle]]
                assert rate[muscle].item() == pytest.approx(mujoco.mju_muscleDynamics(control, now, prm[:3]), abs=1e-12)


def test_what_is_off_stays():
    groups = ('name="slow"', 'name="slow" group="3"'), ('timestep="0.002"', 'timestep="0.002" actuatorgroupdisable="3"')
    scene = zoo.load("activated", *groups)
    states, actions = simulated(scene)
    slow = scene.activations.actuator.tolist().index(scene.actuator_names.index("slow"))
    at = scene.activations.node[slow], 13 + scene.activations.slot[slow]
    assert torch.equal(states[:, -1, at[0], at[1]], states[:, 0, at[0], at[1]])
    change = ForwardModel.for_scene(scene, **SMALL).bind(scene).delta(states[:, 0], actions[:, 0])
    assert not change[:, at[0], at[1] - 1].any()


def test_observations_and_steps_show_the_same_activations():
    scene = zoo.load("activated")
    simulator = Simulator(scene, 1)
    states, _ = simulated(scene)
    held = scene.activations
    physics = torch.zeros(1, scene.physics_size, dtype=torch.float64)
    physics[0, -scene.model.na :] = torch.arange(1.0, 1 + scene.model.na)
    shown = simulator.observe(physics)[0]
    assert shown[held.node, 13 + held.slot].tolist() == physics[0, -scene.model.na :].tolist()
    assert simulator.step(physics.numpy(), np.zeros((1, scene.num_actions)))[1][0].tolist() == shown.tolist()
    assert states.shape[-1] == scene.state_size == 13 + held.size


@pytest.fixture(scope="module")
def activated():
    return zoo.load("activated")


@pytest.fixture(scope="module")
def trained(activated):
    data = collect_trajectories(activated, 60, steps=30, seed=0)
    model = ForwardModel.for_scene(activated, **SMALL)
    fit(model.bind(activated), data, steps=30, batch_size=64, seed=0)
    return model, data


@pytest.mark.slow
def test_predictions_in_cpp_are_torchs(activated, trained):
    model, data = trained
    native, eager = (specialize(model.bind(activated), executor=name) for name in ("native", "eager"))
    assert native.reason is None
    found = []
    for predictor in (native, eager):
        state = data["state"][:5, 0].clone().requires_grad_()
        actions = data["action"][:5, :6].clone().requires_grad_()
        states = predictor.rollout(state, actions)[0]
        gradients = torch.autograd.grad(states[:, -1].square().sum(), (state, actions))
        moves = torch.as_tensor(activated.movable[:, 6:])  # velocities and activations
        found.append((states.detach(), gradients[0][..., 7:][:, moves], gradients[1]))
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
    # A control moves a servo through its activation alone, and the activation's gradient arrives.
    assert (found[1][1].abs().amax(0) > 0).all()


@pytest.mark.slow
def test_errors_leave_out_what_follows_by_a_law(activated, trained):
    model, data = trained
    table = evaluate_errors(model.bind(activated), data[:4], horizons=[5])
    assert "activation" not in table["rollout_error_5"].components
    rollout = model.bind(activated).rollout(data["state"][:4, 0], data["action"][:4, :20])[0]
    torch.testing.assert_close(rollout[..., 13:], data["state"][:4, :21, :, 13:], rtol=1e-9, atol=1e-11)


def test_networks_see_activations_and_the_forces_of_muscles(activated, trained):
    model, data = trained
    names = [type(feature).__name__ for feature in model.features]
    assert {"Activations", "Actuators"} <= set(names)
    bound, state, action = model.bind(activated), data["state"][:1, 3], data["action"][:1, 3]
    held, before = activated.activations, bound.delta(state, action)
    for place in zip(held.node.tolist(), (13 + held.slot).tolist(), strict=True):
        changed = state.clone()
        changed[0, place[0], place[1]] += 0.3
        assert not torch.allclose(bound.delta(changed, action)[..., :12], before[..., :12], rtol=0, atol=1e-9)


PID = """<mujoco model="pid"><extension><plugin plugin="mujoco.pid"><instance name="pid">
    <config key="kp" value="40"/><config key="ki" value="40"/><config key="imax" value="40"/>
  </instance></plugin></extension>
  <worldbody><body name="slider"><joint name="x" type="slide" axis="1 0 0"/><geom size=".1"/></body></worldbody>
  <actuator><plugin joint="x" plugin="mujoco.pid" instance="pid" actdim="1" ctrlrange="-1 1"/></actuator></mujoco>"""


@pytest.mark.slow
def test_a_plugins_activation_is_shown_and_learned():
    scene = load_scene(PID)
    assert scene.activations.known.tolist() == [False] and scene.state_size == 14
    physics = torch.zeros(2, scene.physics_size, dtype=torch.float64)
    physics[1, 3] = 0.5  # time, position, velocity, integral
    after = Simulator(scene, 1).rollout(physics, torch.zeros(2, 1, 1, dtype=torch.float64))["state"]
    assert not torch.equal(after[0, 0], after[1, 0]) and not torch.equal(after[0, 1], after[1, 1])
    bound = ForwardModel.for_scene(scene, **SMALL).bind(scene)
    assert bound.movable[1, 12] and type(bound.model.features[-1]) is Activations
    data = collect_trajectories(scene, 100, steps=20, seed=0)
    fit(bound, data, steps=300, batch_size=128, seed=0)
    table = evaluate_errors(bound, data, horizons=[1])
    assert table["one_step_error"].components["activation"] < 0.2


def test_models_of_other_states_are_refused(activated):
    with pytest.raises(ValueError, match="is .*'activation'"):
        ForwardModel.for_scene("pendulum", **SMALL).bind(activated)


def test_variants_share_their_laws(activated):
    bound = ForwardModel.for_scene(activated, parameters="scene", **SMALL).bind(activated, parameters_key="parameters")
    other = zoo.load("activated", ('dynprm=".1"', 'dynprm=".2"'))
    with pytest.raises(ValueError, match="activations"):
        bound.parameters_of(other)


def test_servos_start_with_the_target_that_holds_them(activated):
    """An integrating servo keeps the pose that it starts in, anywhere within its limits."""
    simulator = Simulator(activated, 1)
    start, _ = draw_start_states(simulator, np.zeros(20, dtype=np.int64), np.random.default_rng(0))
    twist, first = start[:, 3], 1 + activated.model.nq + activated.model.nv
    low, high = activated.model.actuator_actrange[activated.actuator_names.index("pace")]
    pace = start[:, first + activated.model.actuator_actadr[activated.actuator_names.index("pace")]]
    np.testing.assert_allclose(pace, np.clip(twist, low, high))
    assert np.ptp(twist) > 1


def test_environments_hold_activations(activated, trained):
    model, data = trained
    env, true = ModelEnv(model.bind(activated), seed=0), SceneEnv(activated, seed=0)
    assert env.observation_spec["state"].shape == true.observation_spec["state"].shape == (4, 13 + 2)
    entries = TensorDict({"state": data["state"][:5, 4], "action": data["action"][:5, 4]}, [5])
    after = env.step(entries)["next", "state"]
    torch.testing.assert_close(after[..., 13:], data["state"][:5, 5, :, 13:], rtol=1e-9, atol=1e-11)
    assert true.rollout(3)["next", "state"].shape == (3, 4, 15)


@pytest.mark.parametrize("kind", [StateFeatures, BodyFrameFeatures])
def test_policies_see_activations(activated, kind, trained):
    features, state = kind(activated, Canonicalizer(recenter=False, yaw=False)), trained[1]["state"][:, 3]
    features.update(trained[1]["state"].flatten(0, 1))
    held, changed = activated.activations, state.clone()
    changed[:, held.node[0], 13 + held.slot[0]] += 0.3
    before, after = (getattr(each, "nodes", each) for each in (features(state), features(changed)))
    assert not torch.equal(before, after)
    assert StatePolicy(activated, hidden=[8]).act(state).shape == (len(state), activated.num_actions)


def test_mujoco_as_physics_takes_them_along(activated, trained):
    data = trained[1]
    physics = MujocoPhysics(activated, num_threads=1)
    found = physics(data["state"][:4, 5], data["action"][:4, 5])
    torch.testing.assert_close(found, data["state"][:4, 6], rtol=0, atol=1e-9)
    bound = ForwardModel.for_scene(activated, physics=physics, **SMALL).bind(activated)
    change = bound.delta(data["state"][:4, 5], data["action"][:4, 5])
    torch.testing.assert_close(change[..., 12:], (found - data["state"][:4, 5])[..., 13:], rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("learned", [False, True])
def test_ilqg_plans_through_activations(activated, trained, learned):
    env = ModelEnv(trained[0].bind(activated), reward, seed=0) if learned else SceneEnv(activated, reward, seed=0)
    start = SceneEnv(activated, seed=0).reset()
    start = start.select("state") if learned else start
    plan = ILQGPlanner(env, horizon=8, iterations=3).plan(start)
    assert plan.shape == (8, activated.num_actions) and plan.isfinite().all() and plan.abs().max() > 0


def reward(state, action, next_state, task):
    return next_state[..., 3, 2:3] - 1e-3 * action.square().sum(-1, keepdim=True)


def test_a_learned_plants_changes_have_activations(activated, trained):
    plant = ILQGPlanner(ModelEnv(trained[0].bind(activated), reward, seed=0), horizon=3).plant()
    state, actions = trained[1]["state"][0, :1].numpy().reshape(-1), trained[1]["action"][0, :2].numpy()
    path = plant.rollout(state, actions[None])[0][0]
    found = plant.linearize(path, actions)
    model = activated.model
    size = 2 * model.nv + model.na
    assert found.dynamics.shape == (2, size, size + model.nu) and found.bodies.shape[-1] == size
    held, changes = activated.activations, []
    for shift in (1e-2, -1e-2):
        shifted = state.copy().reshape(activated.num_nodes, -1)
        shifted[held.node[0], 13 + held.slot[0]] += shift
        moved = plant.rollout(shifted.reshape(-1), actions[None])[0][0]
        changes.append(found.deviation(1, moved[1:2])[0])
    after = (changes[0] - changes[1]) / 2e-2
    np.testing.assert_allclose(after, found.dynamics[0][:, 2 * model.nv], atol=2e-3 * np.abs(after).max())


@pytest.mark.parametrize(
    "change",
    [
        ('dynprm=".1"', 'dynprm=".2"'),
        ('actrange="-.5 .8"', 'actrange="-.5 .7"'),
        ('actearly="true"', 'actearly="false"'),
        ('lengthrange="-.2 .2"', 'lengthrange="-.2 .3"'),
    ],
)
def test_fingerprints_tell_laws_apart(activated, change):
    assert zoo.load("activated", change).fingerprint() != activated.fingerprint()


@pytest.mark.skipif(not hasattr(mujoco.MjModel, "actuator_ctrlnum"), reason="MuJoCo before 3.11 turns the long way")
@pytest.mark.parametrize(
    "target", ['joint="ball" gear="0 0 2"', 'jointinparent="ball" gear="0 0 2"', 'site="end" gear="0 0 0 0 0 2"']
)
def test_an_integrated_target_that_turns_the_short_way_is_learned(target):
    """MuJoCo changes it by whole turns where it is over half a turn away: no law of the activation alone."""
    refsite = ' refsite="base"' if "site" in target else ""
    scene = load_scene(
        f"""<mujoco><option gravity="0 0 0"/><worldbody><site name="base"/>
        <body><joint name="ball" type="ball"/><geom size=".1"/><site name="end"/>
          <body pos=".3 0 0"><joint name="hinge"/><geom size=".1"/></body></body></worldbody>
        <actuator><intvelocity {target}{refsite} kp="1" ctrlrange="-1 1" actrange="-20 20"/>
          <intvelocity joint="hinge" kp="1" ctrlrange="-1 1" actrange="-20 20"/></actuator></mujoco>"""
    )
    physics = torch.from_numpy(scene.rest_physics)[None].clone()
    physics[0, -2:] = 8.0
    state = Simulator(scene, 1).rollout(physics, torch.zeros(1, 1, 2, dtype=torch.float64))["state"]
    changes = (state[0, 1] - state[0, 0])[scene.activations.node, 13 + scene.activations.slot]
    np.testing.assert_allclose(changes, [-4 * np.pi, 0], atol=1e-9)  # a turn, times the gear
    assert scene.activations.known.tolist() == [False, True]
    assert "activations without a law, which are learned: actuator0" in str(scene)
