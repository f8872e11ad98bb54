"""Environments, rewards, values and planners on the device, for real environments there or on the CPU."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import CEMPlanner, MPPIPlanner

import torchrl_gn as gn
from torchrl_gn.data import log_trajectories, log_tree, simulate_log, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.envs.starts import batched
from torchrl_gn.identification import IdentifyingModel
from torchrl_gn.planners import ReturnToGo, TerminalReward
from torchrl_gn.policies import StatePolicy, StateValue
from torchrl_gn.rewards import FreezeGoal, available_rewards
from torchrl_gn.scenes import sample_variants
from torchrl_gn.training import fit_policy, fit_value

from ..sizes import SMALL
from .conftest import SYSTEMS, close, task
from .device import waits, without_waits

scenes = pytest.mark.parametrize("name", SYSTEMS)


@pytest.fixture(scope="session")
def models(systems, data) -> dict[str, ForwardModel]:
    """Models in which actions matter."""
    found = {}
    for name, scene in systems.items():
        torch.manual_seed(0)
        found[name] = ForwardModel.for_scene(scene, **SMALL)
        gn.fit(found[name].bind(scene), data[name], steps=2, progress=False)
        found[name].double()
    return found


@pytest.fixture
def envs(gpu, systems, models):
    """A model's environment on the CPU and on the device."""

    def make(name: str, reward=task, **options) -> list[gn.ModelEnv]:
        bound = [copy.deepcopy(models[name]).to(device).bind(systems[name]) for device in ("cpu", gpu)]
        special = [gn.specialize(each, executor="eager") for each in bound]
        return [gn.ModelEnv(each, copy.deepcopy(reward), seed=0, **options) for each in special]

    return make


def entries(data, name, device="cpu") -> TensorDict:
    """States, in a TensorDict without a device."""
    return TensorDict({"state": data[name]["state"][:, 0].to(device)}, [4])


@scenes
def test_environments(gpu, systems, data, envs, name):
    here, there = envs(name)
    check_env_specs(there)
    action = data[name]["action"][:, 0].float()
    steps = [
        each.step(entries(data, name, each.device).set("action", action.to(each.device))) for each in (here, there)
    ]
    for key in ("state", "reward"):
        close(steps[1]["next", key], steps[0]["next", key], tolerance=1e-6)
    for env in (there, here.to(gpu)):
        assert env.rollout(3)["next", "state"].device == gpu
    check_env_specs(real := gn.SceneEnv(systems[name], task, seed=0, device=gpu))
    assert real.rollout(2)["next", "physics"].device == gpu
    assert batched(there, 3).rollout(2)["next", "reward"].shape == (3, 2, 1)


@scenes
def test_steps_and_imagination_never_wait(gpu, data, envs, name):
    env = envs(name, done=lambda state: state[..., 1, :1] > 1e3)[1]
    now = entries(data, name, gpu)
    action = data[name]["action"][:, :3].float().to(gpu)
    env.step(now.clone().set("action", action[:, 0])), env.imagine_steps(now, action)
    with without_waits():
        env.step(now.clone().set("action", action[:, 0]))
        env.imagine_steps(now, action.requires_grad_()).rewards.sum().backward()


def test_start_states_of_either_device(gpu, systems, data, envs):
    physics = data["cheetah"]["physics"].flatten(0, 1)
    for given in (physics, physics.to(gpu), lambda count, _: physics[:1].expand(count, -1).to(gpu)):
        assert envs("cheetah", start_states=given)[1].reset()["state"].device == gpu
        assert gn.SceneEnv(systems["cheetah"], start_states=given, seed=0, device=gpu).reset()["state"].device == gpu


@pytest.mark.parametrize("name", ["pendulum", *SYSTEMS])
def test_rewards(gpu, name):
    scene = gn.load_scene(name)
    given = gn.collect_trajectories(scene, 3, steps=2, seed=0)
    state, action, after = given["state"][:, 0], given["action"][:, 0], given["state"][:, 1]
    names = [each for system, each in available_rewards() if system.removesuffix("N") in name]
    assert names
    for reward in (gn.make_reward(each, scene) for each in names):
        there, goal = copy.deepcopy(reward).to(gpu), (None, None)
        try:
            wanted = reward(state, action, after, None)
        except ValueError:  # it needs a task
            target = after if reward.target_shape == after.shape[1:] else torch.ones(3, *reward.target_shape)
            goal = reward.task_of(state, target), there.task_of(state.to(gpu), target.to(gpu))
            wanted = reward(state, action, after, goal[0])
        close(there(state.to(gpu), action.to(gpu), after.to(gpu), goal[1]), wanted)


@pytest.mark.parametrize(
    ("name", "real_on"), [("swimmer6", "cpu"), ("swimmer6", "gpu"), ("cheetah", "gpu"), ("jaco", "cpu")]
)
def test_planners(gpu, systems, data, envs, name, real_on):
    scene, place = systems[name], gpu if real_on == "gpu" else "cpu"
    real = gn.SceneEnv(scene, task, seed=0, device=place)
    policy = StatePolicy(scene, hidden=[4])
    fit_policy(policy, gn.SceneEnv(scene, task, seed=0).rollout(5).unsqueeze(0), steps=1)
    plans = []
    for env in envs(name):
        proposal = copy.deepcopy(policy).to(env.device)
        options = {"proposal": proposal, "propose_every_step": True, "seed": 0}
        gradient = gn.GradientPlanner(env, horizon=2, iterations=1, warm_up=1, candidates=2, **options)
        ilqg = gn.ILQGPlanner(env, horizon=2, iterations=1, warm_up=1, **options)
        # One proposal, without noise: noise of a policy differs between devices.
        sampling = gn.SamplingPlanner(env, 2, iterations=2, samples=6, elites=3, proposal=proposal, proposals=1, seed=0)
        plans.append([])
        for planner in (gradient, ilqg, sampling):
            planned = entries(data, name, place)
            for _ in range(2):  # a first plan and a later one
                planned = planner(planned)
                assert planned["action"].device == planned["plan", "actions"].device == torch.device(place)
            plans[-1].append(planned["action"].cpu())
            for played in (real, env):
                TransformedEnv(played, planner.make_tensordict_primer()).rollout(1, planner)
    for found, wanted in zip(plans[1], plans[0], strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("kind", ["gradient", "ilqg"])
@pytest.mark.parametrize("background", [False, True])
def test_planning_ahead(gpu, systems, envs, kind, background):
    actions = []
    for env, place in zip([*envs("swimmer6"), envs("swimmer6")[1]], ("cpu", "cpu", gpu), strict=True):
        if kind == "gradient":
            inner = gn.GradientPlanner(env, horizon=3, iterations=1, warm_up=1, candidates=2, seed=0)
        else:
            inner = gn.ILQGPlanner(env, horizon=3, iterations=1, seed=0)
        planner = gn.PlanAhead(inner, background=background)
        real = TransformedEnv(
            gn.SceneEnv(systems["swimmer6"], task, seed=0, device=place), planner.make_tensordict_primer()
        )
        actions.append(real.rollout(3, planner)["action"])
        planner.wait()
        assert actions[-1].device == torch.device(place)
    for found in actions[1:]:
        torch.testing.assert_close(found.cpu(), actions[0], rtol=1e-4, atol=1e-4)


def test_plans_are_improved_without_waiting(gpu, data, envs):
    """A call waits as often however many improvements it makes."""
    env, counts = envs("swimmer6")[1], []
    for iterations in (1, 4):
        gradient = gn.GradientPlanner(env, horizon=2, iterations=1, warm_up=iterations, candidates=2, seed=0)
        counts.append([])
        for planner in (gradient, gn.SamplingPlanner(env, 2, iterations, samples=6, elites=3, seed=0)):
            planner(entries(data, "swimmer6", gpu))
            before = waits()
            planner(entries(data, "swimmer6", gpu))
            counts[-1].append(waits() - before)
    assert counts[0] == counts[1]


def test_planners_of_torchrl(gpu, envs):
    env, options = envs("swimmer6")[1], {"planning_horizon": 3, "optim_steps": 2, "num_candidates": 5, "top_k": 2}
    for planner in (CEMPlanner(env, **options), MPPIPlanner(env, ReturnToGo(), temperature=1.0, **options)):
        assert planner(env.reset())["action"].device == gpu


def test_tasks_ends_and_values(gpu, systems, data, envs):
    scene = systems["cheetah"]
    reward = gn.make_reward("run", scene)
    episodes = gn.SceneEnv(scene, reward, seed=0).rollout(8).unsqueeze(0)
    values = []
    for device, given in (("cpu", episodes), (gpu, episodes), (gpu, episodes.to(gpu))):
        torch.manual_seed(0)
        value = StateValue(scene, discount=0.9, hidden=[4]).to(device)
        fit_value(value, given, steps=2)
        values.append(value(data["cheetah"]["state"].to(device)))
    for found in values[1:]:
        close(found, values[0], tolerance=1e-5)
    options = {"done": lambda state: state[..., 1, :1] > 1e3}
    for terminal in (value.cpu(), TerminalReward(reward, scene, 2.0)):
        env = envs("cheetah", reward, terminal=terminal, **options)[1]
        check_env_specs(env)
        real = gn.SceneEnv(scene, reward, seed=0, terminal=terminal, device=gpu, **options)
        check_env_specs(real)
        for planner in (
            gn.GradientPlanner(env, horizon=2, iterations=1, warm_up=1, candidates=2, seed=0),
            gn.ILQGPlanner(env, horizon=2, iterations=1, seed=0),
            gn.ILQGPlanner(real, horizon=2, iterations=1, seed=0),
        ):
            assert real.rollout(2, planner)["action"].device == gpu


def test_a_target_beside_the_model(gpu, systems, envs):
    """Its task is frozen where the real environment is."""
    scene = systems["swimmer6"]
    reward = gn.make_reward("reach", scene)
    env = envs("swimmer6", reward)[1]
    for planner in (
        gn.GradientPlanner(env, horizon=2, iterations=1, warm_up=1, candidates=2, seed=0),
        gn.ILQGPlanner(env, horizon=2, iterations=1, seed=0),
    ):
        now = gn.SceneEnv(scene, seed=0).reset().set("target", torch.ones(3, dtype=torch.float64))
        assert planner(FreezeGoal(reward)(now))["action"].is_cpu


def test_parameters_of_each_sample(gpu, systems, data):
    scene, variants = systems["swimmer6"], sample_variants("swimmer6", 4, rng=0)
    torch.manual_seed(0)
    model = ForwardModel.for_scene(scene, hidden=4, layers=1, parameters="inferred")
    model = IdentifyingModel(model, node_hidden=[4]).to(gpu)
    loss = gn.IdentificationLoss(model, scene, context_length=4)
    loss.fit_normalizers(trajectory_buffer(data["swimmer6"], batch_size=50, seed=0).sample().to(gpu))
    bound, inference = model.bind(scene)
    estimate = inference.identify(*(data["swimmer6"][key].to(gpu) for key in ("state", "action")))
    env = gn.ModelEnv(gn.specialize(bound), task, seed=0)
    check_env_specs(env)
    planner = gn.GradientPlanner(env, horizon=2, iterations=1, warm_up=1, candidates=2, seed=0)
    for place in ("cpu", gpu):
        now = entries(data, "swimmer6", place).set("parameters", estimate.to(place))
        assert planner(now)["action"].device == torch.device(place)
    real = gn.SceneEnv(variants, task, seed=0, device=gpu)
    assert real.rollout(2, gn.ILQGPlanner(real, horizon=2, iterations=1, seed=0))["variant"].device == gpu


@pytest.mark.parametrize("core", ["gn", "recurrent"])
def test_what_is_carried_from_step_to_step(gpu, core):
    """Past commands of a robot known by its joints, and hidden states."""
    log = simulate_log(gn.load_scene("acrobot"), 3, 60, 0)
    tree, data = log_tree(log, "double", commands=[[0], []], history=2), log_trajectories(log, 20, history=2)[0]
    torch.manual_seed(0)
    options = {"core": "recurrent", "hidden_state": [4, 4, 4]} if core == "recurrent" else {}
    bound = ForwardModel.for_scene(tree, hidden=[8], **options).to(gpu).bind(tree)
    gn.fit(bound, data, steps=1, progress=False)
    env = gn.ModelEnv(bound, task, start_states=data["state"].flatten(0, 1), seed=0)
    check_env_specs(env)
    for planner in (
        inner := gn.GradientPlanner(env, horizon=2, iterations=1, warm_up=1, candidates=2, seed=0),
        gn.PlanAhead(inner),
    ):
        for place in ("cpu", gpu):
            now = env.reset().to(place)
            planned = planner(now)
            carried = [planned["next", key] for key in env.carried_keys]
            assert all(each.device.type == torch.device(place).type for each in carried)
