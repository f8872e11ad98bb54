"""iLQG through learned models: Jacobians against finite differences and MuJoCo, plans that improve, refusals."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase

from torchrl_gn.data import Simulator, sample_start_states
from torchrl_gn.dynamics import specialize
from torchrl_gn.dynamics.mujoco_physics import MujocoPhysics
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.planners import ILQGPlanner
from torchrl_gn.planners.linearize import Tangent
from torchrl_gn.planners.plant import LearnedPlant, SimulatedPlant
from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import Scene, load_scene
from torchrl_gn.training import load_pretrained

from .. import zoo


def path_of(scene: Scene, steps: int) -> tuple[np.ndarray, np.ndarray, Simulator]:
    """Physics ``[steps + 1, S]`` and actions of a simulation."""
    simulator = Simulator(scene, 1)
    rng = np.random.default_rng(0)
    actions = rng.uniform(scene.action_low, scene.action_high, (steps, scene.num_actions))
    simulated = simulator.rollout(sample_start_states(scene, 1, 3), actions[None])
    return cast(torch.Tensor, simulated["physics"])[0].numpy(), actions, simulator


@pytest.mark.parametrize("name", ["pendulum", "swimmer6", "cheetah"])
def test_the_jacobians_are_those_of_the_model(scenes, make_model, name):
    scene = scenes[name]
    predictor = specialize(make_model(scene).double().requires_grad_(False).bind(scene))
    physics, actions, simulator = path_of(scene, 3)
    states = simulator.observe(physics)
    plant, tangent, epsilon = LearnedPlant(predictor), Tangent(scene), 1e-6
    local = plant.linearize(states.flatten(1).numpy(), actions)
    size = 2 * scene.model.nv
    assert local.dynamics.shape == (3, size, size + scene.num_actions)

    def after(t: int, start: np.ndarray, controls: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            moved = predictor.step(simulator.observe(start), torch.from_numpy(controls))[0]
        return local.deviation(t + 1, moved.flatten(1).numpy())

    for t in range(2):
        change = epsilon * np.eye(tangent.size)[:size]
        ends = [after(t, tangent.add(physics[t], sign * change), np.tile(actions[t], (size, 1))) for sign in (1, -1)]
        by_state = (ends[0] - ends[1]).T / (2 * epsilon)
        pushed = epsilon * np.eye(scene.num_actions)
        start = np.tile(physics[t], (len(pushed), 1))
        ends = [after(t, start, actions[t] + sign * pushed) for sign in (1, -1)]
        by_action = (ends[0] - ends[1]).T / (2 * epsilon)
        wanted = np.concatenate((by_state, by_action), axis=1)
        assert np.abs(local.dynamics[t] - wanted).max() < 1e-6 * np.abs(wanted).max()


@pytest.mark.parametrize("name", ["pendulum", "swimmer6", "quadrotor"])
def test_a_model_that_is_the_physics_has_its_linearization(name):
    scene = zoo.load(name) if name == "quadrotor" else load_scene(name)
    exact = MujocoPhysics(scene, num_threads=1)
    model = SimpleNamespace(scene=scene, step=lambda state, action: (exact(state, action), None))
    physics, actions, simulator = path_of(scene, 4)
    wanted = SimulatedPlant(simulator, central=True).linearize(physics, actions)
    found = LearnedPlant(model).linearize(simulator.observe(physics).flatten(1).numpy(), actions)  # type: ignore[arg-type]
    np.testing.assert_allclose(found.bodies, wanted.bodies, atol=1e-6)
    scale = np.abs(wanted.dynamics).max()
    np.testing.assert_allclose(found.dynamics, wanted.dynamics, atol=1e-4 * scale)


def test_states_without_joint_coordinates_change_in_all_channels(make_model):
    scene = zoo.load("odd")
    plant = LearnedPlant(specialize(make_model(scene).double().requires_grad_(False).bind(scene)))
    physics, actions, simulator = path_of(scene, 2)
    local = plant.linearize(simulator.observe(physics).flatten(1).numpy(), actions)
    channels = 13 * scene.num_nodes
    assert local.dynamics.shape == (2, channels, channels + scene.num_actions)
    assert np.isfinite(local.dynamics).all() and np.abs(local.dynamics).max() > 0


@pytest.mark.slow
@pytest.mark.parametrize(("name", "task"), [("pendulum", "balance"), ("cheetah", "forward")])
def test_more_iterations_find_better_plans(name, task):
    scene = load_scene(name)
    reward = make_reward(task, scene)
    model = load_pretrained(name).model
    env = ModelEnv(specialize(model.bind(scene)), reward)
    start = SceneEnv(scene, reward, seed=1).reset().exclude("physics")
    start = cast(TensorDictBase, torch.stack([start, start.clone()]))
    returns = []
    for iterations in (0, 1, 5):
        planner = ILQGPlanner(env, 10, 1, warm_up=iterations, seed=0)
        with torch.no_grad():
            plan = planner.plan(start)
        assert plan.shape == (2, 10, scene.num_actions)
        assert (plan >= torch.as_tensor(scene.action_low)).all() and (plan <= torch.as_tensor(scene.action_high)).all()
        returns.append(env.imagine(start, plan)[1].sum((-2, -1)).detach())
    # Of two rows each draws its own first sequences.
    assert (returns[1] > returns[0]).all() and (returns[2] >= returns[1]).all()
    assert all(each.requires_grad for each in model.parameters())  # as before


def test_it_plays_an_episode(scenes, make_model):
    scene = scenes["pendulum"]
    reward = make_reward("balance", scene)
    planner = ILQGPlanner(ModelEnv(specialize(make_model(scene).bind(scene)), reward), 4, 1, seed=0)
    played = SceneEnv(scene, reward, seed=0).rollout(3, planner)
    assert played["action"].shape == (3, 1) and played["plan", "planned"].all()


def test_it_plans_in_inference_mode(scenes, make_model):
    scene = scenes["pendulum"]
    env = ModelEnv(specialize(make_model(scene).bind(scene)), make_reward("balance", scene), seed=0)
    start, actions = env.reset(), []
    for mode in (torch.no_grad, torch.inference_mode):
        with mode():
            actions.append(ILQGPlanner(env, 4, 2, seed=0)(start.clone())["action"])
    assert torch.equal(*actions)


def test_it_plans_in_the_environments_present_model(scenes, make_model):
    scene = scenes["pendulum"]
    env = ModelEnv(specialize(load_pretrained("pendulum").bind(scene)), make_reward("balance", scene), seed=0)
    options, start = {"horizon": 4, "iterations": 2, "warm_up": 2, "control_cost": 1.0, "seed": 0}, env.reset()
    planner = ILQGPlanner(env, **options)
    before = planner(start.clone())["plan", "actions"]
    env.world_model = specialize(make_model(scene).bind(scene))
    planner.set_seed(0)
    after = planner(start.clone())["plan", "actions"]
    wanted = ILQGPlanner(env, **options)(start.clone())["plan", "actions"]
    assert torch.equal(after, wanted) and not torch.equal(after, before)


def test_what_it_refuses(scenes, make_model):
    scene = scenes["pendulum"]
    reward = make_reward("balance", scene)
    recurrent = ModelEnv(make_model(scene, core="recurrent").bind(scene), reward)
    with pytest.raises(ValueError, match=r"reads \['hidden_state'\]: use GradientPlanner"):
        ILQGPlanner(recurrent, 3)
    variants = ModelEnv(make_model(scene).bind(scene, parameters_key="parameters"), reward)
    with pytest.raises(ValueError, match=r"reads \['parameters'\]: use GradientPlanner"):
        ILQGPlanner(variants, 3)
    planner = ILQGPlanner(ModelEnv(make_model(scene).bind(scene), reward), 3, 1)
    start = SceneEnv(scene, reward, seed=0).reset()
    with pytest.raises(KeyError, match="'state', the state of the bodies"):
        planner(start.exclude("state"))
    with pytest.raises(ValueError, match="'state' must be"):
        planner(start.clone().set("state", torch.zeros(3, 13)))
