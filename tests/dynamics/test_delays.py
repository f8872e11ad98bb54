"""Delayed actuators: past controls as state, and times of effect, against MuJoCo's own simulation of the file."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.data import UncontrolledSceneWarning, collect_trajectories
from torchrl_gn.data.simulate import Simulator
from torchrl_gn.data.start_states import draw_start_states
from torchrl_gn.dynamics import ForwardModel, MujocoPhysics, specialize
from torchrl_gn.dynamics.delayed_controls import DelayedControls
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.evaluation import evaluate_errors, half_step_errors
from torchrl_gn.planners import ILQGPlanner
from torchrl_gn.planners.linearize import Tangent
from torchrl_gn.scenes import UnsupportedSceneError, load_scene, scene_from_description
from torchrl_gn.scenes.simulated_invariance import Motion, changes_dynamics
from torchrl_gn.scenes.topology import topology
from torchrl_gn.training import fit

from .. import zoo
from ..sizes import SMALL

pytestmark = pytest.mark.skipif(not hasattr(mujoco.MjModel, "actuator_history"), reason="needs MuJoCo 3.5")

STEP = 10  # physics steps of 2 ms in a control step
# Actuators of activated.xml with delays, buffers and lags: of less and more than a control step, and a short buffer.
LATE = {
    "plain": ("0.007", 40, 4),
    "slow": ("0.05", 40, 25),
    "servo": ("0.02", 10, 10),
    "pace": ("0.0231", 40, 12),
    "extensor": ("0.041", 40, 21),
    "early": ("0.05", 17, 17),
}
EDITS = tuple(
    (f'name="{name}"', f'name="{name}" delay="{late}" nsample="{kept}"') for name, (late, kept, _) in LATE.items()
)


def late_mjcf(*edits: tuple[str, str]) -> str:
    text = zoo.mjcf("activated", *edits)
    head, actuators = text.split("<actuator>")
    for old, new in EDITS:
        assert actuators.count(old) == 1
        actuators = actuators.replace(old, new)
    return f"{head}<actuator>{actuators}"


@pytest.fixture(scope="module")
def scene():
    return load_scene(late_mjcf())


def random_actions(scene, count: int, steps: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.as_tensor(scene.action_low), torch.as_tensor(scene.action_high)
    return low + (high - low) * torch.rand(count, steps, len(low), generator=generator, dtype=torch.float64)


def rollout(scene, count: int = 4, steps: int = 8) -> tuple[TensorDict, torch.Tensor]:
    start = torch.from_numpy(np.tile(scene.rest_physics, (count, 1)))
    actions = random_actions(scene, count, steps)
    return Simulator(scene, 1).rollout(start, actions), actions


def past_of(scene, states: torch.Tensor) -> torch.Tensor:
    late = scene.delays
    return states[..., late.node, 13 + scene.activations.size + late.slot]


def test_lags_are_mujocos(scene):
    names = list(scene.actuator_names)
    assert {name: scene.delays.lag[names.index(name)] for name in LATE} == {
        name: lag for name, (*_, lag) in LATE.items()
    }
    assert scene.delays.lag[names.index("biceps")] == 0
    ages = {name: max(scene.delays.age[scene.delays.actuator == names.index(name)]) for name in LATE}
    assert ages == {name: -(-lag // STEP) for name, (*_, lag) in LATE.items()}


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_simulations_are_those_of_the_file(integrator):
    text = late_mjcf(('timestep="0.002"', f'timestep="0.002" integrator="{integrator}"'))
    scene = load_scene(text)
    data, actions = rollout(scene, 2)
    own = mujoco.MjModel.from_xml_string(text)
    own.actuator_ctrlrange[:], own.actuator_ctrllimited[:] = (
        scene.model.actuator_ctrlrange,
        scene.model.actuator_ctrllimited,
    )
    own.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_WARMSTART)
    end = 1 + own.nq + own.nv + own.na
    for row in range(2):
        held = mujoco.MjData(own)
        held.time = 0.0
        for step in range(actions.shape[1]):
            held.ctrl[:] = actions[row, step]
            mujoco.mj_step(own, held, nstep=STEP)
            at = np.concatenate(([held.time], held.qpos, held.qvel, held.act))
            np.testing.assert_allclose(data["physics"][row, step + 1, :end], at, rtol=1e-9, atol=1e-10)


def test_states_hold_the_controls_of_earlier_steps(scene):
    data, actions = rollout(scene)
    held = past_of(scene, data["state"])
    for index, (actuator, age) in enumerate(zip(scene.delays.actuator, scene.delays.age, strict=True)):
        given = torch.cat((torch.zeros(len(actions), int(age)), actions[..., actuator]), dim=1)[:, : held.shape[1]]
        assert torch.equal(held[..., index], given)
    assert not held[:, 0].any() and held[:, -1].all()


def test_steps_and_rollouts_are_the_same_bit_for_bit(scene):
    data, actions = rollout(scene)
    simulator, physics = Simulator(scene, 1), data["physics"][:, 0].numpy()
    for step in range(actions.shape[1]):
        physics, state = simulator.step(physics, actions[:, step].numpy())
        assert np.array_equal(state, data["state"][:, step])
    assert np.array_equal(physics, data["physics"][:, -1])
    assert np.array_equal(simulator.observe(physics), data["state"][:, -1])


def test_settling_keeps_the_time_and_what_acts(scene):
    """The settled controls act after settling, at any time of the state."""
    data, actions = rollout(scene, 2)
    simulator = Simulator(scene, 1)
    settled, stable = simulator.settle(data["physics"][:, 4].numpy(), 40)
    assert stable.all() and np.array_equal(settled[:, 0], data["physics"][:, 4, 0])
    assert not past_of(scene, simulator.observe(settled)).any()
    long = simulator.rollout(
        data["physics"][:, 4], torch.cat((torch.zeros(2, 4, scene.num_actions), actions[:, :3]), dim=1)
    )
    again = simulator.rollout(settled, actions[:, :3])
    torch.testing.assert_close(again["state"], long["state"][:, 4:], rtol=1e-9, atol=1e-10)


def test_what_acts_is_known(scene):
    data, actions = rollout(scene)
    state, steps = data["state"][:, 5], scene.substeps
    controls = DelayedControls(scene)
    first, later, _ = controls(state, actions[:, 5])
    lag = scene.delays.lag
    flat = actions.repeat_interleave(steps, dim=1)  # a physics step each
    acting = torch.stack(
        [flat[:, 5 * steps + torch.arange(steps) - int(late), a] for a, late in enumerate(lag)], dim=-1
    )
    assert torch.equal(first, acting[:, 0]) and torch.equal(later[:, lag % steps > 0], acting[:, -1, lag % steps > 0])
    torch.testing.assert_close(controls.mean(first, later), acting.mean(1), rtol=1e-12, atol=1e-12)
    after = controls(data["state"][:, 6], actions[:, 6])
    assert torch.equal(later[:, lag > 0], after.first[:, lag > 0])  # an end is the next step's start


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_predictions_follow_the_laws(integrator):
    scene = load_scene(late_mjcf(('timestep="0.002"', f'timestep="0.002" integrator="{integrator}"')))
    bound = ForwardModel.for_scene(scene, **SMALL).bind(scene)
    data, actions = rollout(scene)
    change = bound.delta(data["state"][:, :-1].flatten(0, 1), actions.flatten(0, 1))[..., 12:]
    moved = (data["state"][:, 1:] - data["state"][:, :-1])[..., 13:].flatten(0, 1)
    count = scene.model.na + len(scene.delays.actuator)
    assert (moved.abs().amax(0) > 1e-3).sum() == count == scene.movable[:, 12:].sum()
    torch.testing.assert_close(change, moved, rtol=1e-9, atol=1e-11)
    assert not bound.movable[:, 12:].any()


@pytest.fixture(scope="module")
def trained(scene):
    data = collect_trajectories(scene, 60, steps=30, seed=0)
    model = ForwardModel.for_scene(scene, **SMALL)
    fit(model.bind(scene), data, steps=30, batch_size=64, seed=0, progress=False)
    return model, data


def test_networks_see_what_acts_and_not_what_waits(scene, trained):
    """A control that acts in this step changes the prediction; one that waits does not, nor a present one."""
    bound, data = trained[0].bind(scene), trained[1]
    state, action = data["state"][:1, 3], data["action"][:1, 3]
    before = bound.delta(state, action)[..., :12]
    names = list(scene.actuator_names)

    def changes(actuator: str, age: int) -> bool:
        which, changed, given = names.index(actuator), state.clone(), action.clone()
        held = (scene.delays.actuator == which) & (scene.delays.age == age)
        if age:
            changed[:, scene.delays.node[held], 13 + scene.activations.size + scene.delays.slot[held]] -= 0.1
        else:
            given[:, which] -= 0.1
        return not torch.equal(bound.delta(changed, given)[..., :12], before)

    assert [changes("plain", age) for age in (0, 1)] == [True, True]  # four of ten physics steps late
    assert [changes("slow", age) for age in (0, 1, 2, 3)] == [False, False, True, True]
    assert [changes("pace", age) for age in (0, 1, 2)] == [False, True, True]


@pytest.mark.slow
def test_predictions_in_cpp_are_torchs(scene, trained):
    model, data = trained
    native, eager = (specialize(model.bind(scene), executor=name) for name in ("native", "eager"))
    assert native.reason is None
    found = []
    for predictor in (native, eager):
        state = data["state"][:5, 4].clone().requires_grad_()
        actions = data["action"][:5, 4:12].clone().requires_grad_()
        states = predictor.rollout(state, actions)[0]
        of_bodies = states[:, -1, :, :13].square().sum()
        gradients = torch.autograd.grad(of_bodies, (state, actions))
        found.append((states.detach(), past_of(scene, gradients[0]), gradients[1]))
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(past_of(scene, found[1][0]), past_of(scene, data["state"][:5, 4:13]))
    slow = scene.actuator_names.index("slow")
    assert found[1][2][:, :5, slow].all() and not found[1][2][:, 6:, slow].any()  # 25 of 10 physics steps late


def test_errors_leave_past_controls_out(scene, trained):
    table = evaluate_errors(trained[0].bind(scene), trained[1][:4], horizons=[5])
    assert "past_control" not in table["rollout_error_5"].components


def test_half_a_physics_step_has_the_same_delays(scene):
    data = collect_trajectories(scene, 6, steps=12, seed=0)
    own = half_step_errors(scene, data, horizons=[12], num_threads=1)["rollout_error_12"].total
    prompt = zoo.load("activated")
    free = half_step_errors(prompt, collect_trajectories(prompt, 6, steps=12, seed=0), horizons=[12], num_threads=1)
    assert 0 < own < 5 * free["rollout_error_12"].total


def test_servos_start_with_the_target_that_holds_them(scene):
    start, _ = draw_start_states(Simulator(scene, 1), np.zeros(20, dtype=np.int64), np.random.default_rng(0))
    which = scene.actuator_names.index("servo")
    held = past_of(scene, Simulator(scene, 1).observe(start))[:, scene.delays.actuator == which]
    np.testing.assert_allclose(held[:, 0], np.clip(start[:, 3], -1, 1))
    assert np.ptp(start[:, 3]) > 1


def test_mujoco_as_physics_takes_them_along(scene):
    data, actions = rollout(scene)
    physics = MujocoPhysics(scene, num_threads=1)
    state = data["state"][:, 5].clone().requires_grad_()
    after = physics(state, actions[:, 5])
    torch.testing.assert_close(after, data["state"][:, 6], rtol=0, atol=1e-9)
    (gradient,) = torch.autograd.grad(after[..., 10:13].sum(), state)
    slow = scene.delays.actuator == scene.actuator_names.index("slow")
    of_slow = past_of(scene, gradient)[:, slow]  # by age: the second and third act
    assert not of_slow[:, 0].any() and of_slow[:, 1:].all()


def test_changes_of_physics_include_past_controls(scene):
    data, _ = rollout(scene)
    tangent, physics = Tangent(scene), data["physics"][:, 6].numpy()
    change = np.random.default_rng(0).normal(size=(len(physics), tangent.size))
    changed = tangent.add(physics, change)
    np.testing.assert_allclose(tangent.subtract(changed, physics), change, atol=1e-12)
    moved = past_of(scene, Simulator(scene, 1).observe(changed)) - past_of(scene, data["state"][:, 6])
    np.testing.assert_allclose(moved, change[:, -len(scene.delays.actuator) :], atol=1e-12)


def reward(state, action, next_state, task):
    return next_state[..., 3, 2:3] - 1e-3 * action.square().sum(-1, keepdim=True)


@pytest.mark.slow
@pytest.mark.parametrize("learned", [False, True])
def test_ilqg_plans_through_delays(scene, trained, learned):
    env = ModelEnv(trained[0].bind(scene), reward, seed=0) if learned else SceneEnv(scene, reward, seed=0)
    start = SceneEnv(scene, seed=0).reset()
    start = start.select("state") if learned else start
    planner = ILQGPlanner(env, horizon=8, iterations=3)
    plan = planner.plan(start)
    assert plan.isfinite().all() and plan[0].any()
    plant, actions = planner.plant(), plan.double().numpy()
    given = start["state"] if learned else start["physics"]
    path = plant.rollout(given.double().numpy().reshape(-1), actions[None])[0][0]
    found = plant.linearize(path, actions)
    # A control arrives after its delay: along the first Jacobians, not before.
    slow = scene.actuator_names.index("slow")
    speeds = slice(scene.model.nv, 2 * scene.model.nv)
    arrived, size = found.dynamics[0][:, found.dynamics.shape[1] + slow], found.dynamics.shape[1]
    reached = []
    for step in range(1, 5):
        reached.append(bool(np.abs(arrived[speeds]).max() > 1e-7))
        arrived = found.dynamics[step][:, :size] @ arrived
    assert reached == [False, False, True, True]


def test_descriptions_and_fingerprints_have_delays(scene):
    again = scene_from_description(scene.description())
    assert again.fingerprint() == scene.fingerprint() and np.array_equal(again.delays.lag, scene.delays.lag)
    other = load_scene(late_mjcf().replace('delay="0.05" nsample="40"', 'delay="0.06" nsample="40"'))
    assert len({each.fingerprint() for each in (scene, other, zoo.load("activated"))}) == 3
    bound = ForwardModel.for_scene(scene, parameters="scene", **SMALL).bind(scene, parameters_key="parameters")
    with pytest.raises(ValueError, match="delays|movable"):
        bound.parameters_of(load_scene(late_mjcf().replace('delay="0.05" nsample="40"', 'delay="0.054" nsample="40"')))


def test_scenes_say_which_are_late(scene):
    assert "slow (50 ms)" in str(scene) and "plain (8 ms)" in str(scene)


PUSHED = """<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><site name="fixed"/>
  <body pos="0 0 1"><freejoint/><geom size=".1" mass="1"/><site name="tip" pos=".1 0 0"/></body></worldbody>
  <actuator><general site="tip" refsite="fixed" gear="1 0 0 0 0 0" ctrlrange="-1 1" {}/></actuator></mujoco>"""


def test_late_forces_tell_what_is_invariant():
    """A force along an axis of the world turns with no scene, though it acts late."""
    turn = Motion(np.zeros(3), 2, 0.7)
    for delay in ("", 'delay="0.05" nsample="9"'):
        model = load_scene(PUSHED.format(delay)).model
        assert changes_dynamics(model, topology(model), turn, contacts=False)


def test_actions_that_act_after_long_matter(recwarn):
    late = load_scene(PUSHED.format('delay="0.35" nsample="40"'))
    data = collect_trajectories(late, 2, steps=25, seed=0)
    assert not [each for each in recwarn if each.category is UncontrolledSceneWarning]
    assert torch.isfinite(data["state"]).all() and late.delays.age.max() == 18


@pytest.mark.parametrize(
    ("edits", "delay", "words"),
    [
        ([], 'delay=".01" nsample="9" interp="linear"', ["'plain'", "interpolated", 'interp="zoh"']),
        ([('timestep="0.002"', 'timestep="0.002" integrator="RK4"')], 'delay=".01" nsample="9"', ["'plain'", "RK4"]),
    ],
)
def test_delays_that_depend_on_the_absolute_time_are_refused(edits, delay, words):
    text = zoo.mjcf("activated", *edits, ('name="plain"', f'name="plain" {delay}'))
    with pytest.raises(UnsupportedSceneError) as error:
        load_scene(text)
    assert all(word in str(error.value) for word in words)
