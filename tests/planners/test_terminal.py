"""Short plans that end in a value: against the long horizon's optimum, with every planner."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs
from torchrl.modules import CEMPlanner, MPPIPlanner

from torchrl_gn.data import collect_trajectories
from torchrl_gn.dynamics import specialize
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.planners import GradientPlanner, ILQGPlanner, ReturnToGo, TerminalReward
from torchrl_gn.planners.ilqg_solver import ILQGSolver
from torchrl_gn.planners.linearize import RewardExpansion
from torchrl_gn.policies import StateValue
from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import load_scene

from ..sizes import SMALL
from .test_gradient_planner import CONTROL_COST, SPEED_WEIGHT, STEP, Point, at, cart, quadratic, trained

A, B = np.array([[1.0, STEP], [0.0, 1.0]]), np.array([[STEP**2], [STEP]])
SHORT, LONG = 3, 40


class CostToGo:
    """Cost to go of the linear quadratic problem, ``steps`` before its end or with an infinite horizon."""

    def __init__(self, steps: int, discount: float) -> None:
        self.discount, matrix = discount, np.zeros((2, 2))
        for _ in range(steps):
            after = np.diag([1.0, SPEED_WEIGHT]) + discount * matrix
            self.gain = np.linalg.solve(CONTROL_COST + B.T @ after @ B, B.T @ after @ A)
            matrix = A.T @ after @ (A - B @ self.gain)
        self.matrix = torch.from_numpy(matrix)

    def __call__(self, state: torch.Tensor) -> torch.Tensor:
        point = state[..., 1, [0, 7]]
        return -((point @ self.matrix.to(point)) * point).sum(-1, keepdim=True)


def nothing(state: torch.Tensor) -> torch.Tensor:
    return state.new_zeros(*state.shape[:-2], 1)


def model_env(terminal=None) -> ModelEnv:
    return ModelEnv(Point(cart(20.0)), quadratic, terminal=terminal)


def scene_env(terminal=None, seed=0) -> SceneEnv:
    return SceneEnv(cart(20.0), quadratic, terminal=terminal, num_threads=1, seed=seed)


def planned(name: str, terminal=None, start=None) -> torch.Tensor:
    """First actions of a planner, from places 1 and -0.5 by default."""
    start, horizon = at(1.0, -0.5) if start is None else start, SHORT
    if name == "gn":
        planner = GradientPlanner(model_env(terminal), horizon, warm_up=300, samples=4, seed=0)
    elif name == "ilqg":
        env = scene_env(terminal)
        physics = env.reset(TensorDict(batch_size=[2]))["physics"]
        physics[:, 1], physics[:, 2] = start["state"][:, 1, 0], start["state"][:, 1, 7]
        start = env.reset(TensorDict({"physics": physics}, [2]), set_state=True)
        planner = ILQGPlanner(env, horizon, iterations=10, control_cost=0.0, seed=0)
    else:
        torch.manual_seed(0)
        sizes = {"planning_horizon": horizon, "optim_steps": 15, "num_candidates": 500, "top_k": 25}
        env = model_env(terminal)
        planner = CEMPlanner(env, **sizes) if name == "cem" else MPPIPlanner(env, ReturnToGo(), 20.0, **sizes)
    return planner(start)["action"].double()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gn", "ilqg", "cem", "mppi"])
@pytest.mark.parametrize("discount", [1.0, 0.9])
def test_a_short_horizon_and_the_true_value_act_as_the_long_horizon(name, discount):
    sampling = name in ("cem", "mppi")
    # They draw first actions from -1 to 1, and their plans have noise.
    places, noise = ([0.2, -0.1], 0.15) if sampling else ([1.0, -0.5], 0.02)
    whole, rest = CostToGo(LONG, discount), CostToGo(LONG - SHORT, discount)
    optimum = -whole.gain[0, 0] * torch.tensor(places, dtype=torch.float64).unsqueeze(1)
    torch.testing.assert_close(planned(name, rest, start=at(*places)), optimum, rtol=0.02, atol=noise)
    short_sighted = planned(name, start=at(*places))
    assert ((short_sighted - optimum).abs() > 2 * noise + 0.1 * optimum.abs()).any()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gn", "ilqg", "cem", "mppi"])
def test_a_value_of_nothing_changes_no_bit(name):
    assert torch.equal(planned(name, nothing), planned(name))


@pytest.mark.parametrize("make", [model_env, scene_env])
def test_rewards_of_steps_sum_to_those_of_the_plan(make):
    value = CostToGo(5, 0.9)
    env, plain = make(value), make()
    start = env.reset(TensorDict(batch_size=[3]))
    torch.manual_seed(0)
    actions = torch.randn(3, 6, 1)
    check_env_specs(env)
    totals, bare, now, other = 0.0, 0.0, start.clone(), start.exclude("discount")
    for t, action in enumerate(actions.unbind(1)):
        stepped, without = env.step(now.set("action", action))["next"], plain.step(other.set("action", action))["next"]
        totals, bare = totals + stepped["reward"], bare + 0.9**t * without["reward"]
        now, other = stepped.exclude("reward"), without.exclude("reward")
    torch.testing.assert_close(now["discount"], torch.full((3, 1), 0.9**6))
    expected = bare + 0.9**6 * value(now["state"]) - value(start["state"])
    torch.testing.assert_close(totals.double(), expected.double(), rtol=1e-4, atol=1e-5)
    if make is model_env:
        imagined = env.imagine(start, actions)[1].sum(-2)
        torch.testing.assert_close(imagined.double(), expected + value(start["state"]), rtol=1e-4, atol=1e-5)


def test_nothing_follows_where_an_episode_terminates():
    value = CostToGo(5, 0.9)
    env = ModelEnv(Point(cart(20.0)), quadratic, done=lambda state: state[..., 1, 0] > 0.5, terminal=value)
    start = at(1.0, 0.1).set("action", torch.zeros(2, 1))
    stepped = env.step(start)["next"]
    reward = quadratic(start["state"], start["action"], stepped["state"], None)
    after = torch.tensor([[0.0], [0.9]]) * value(stepped["state"])
    torch.testing.assert_close(stepped["reward"], (reward + after - value(start["state"])).float())


def learned_value(scene, discount: float = 0.9) -> StateValue:
    """A value with features of the scene and random weights."""
    torch.manual_seed(1)
    value = StateValue(scene, hidden=(16, 16), discount=discount)
    value.features.fit(collect_trajectories(scene, 5, 20, seed=0)["state"])
    value.normalizer.update(torch.tensor([[-30.0], [10.0]]))
    return value


@pytest.mark.parametrize("kind", ["bound", "specialized"])
def test_gradient_planner_ascends_a_learned_value(kind):
    """Its gradient by the actions equals finite differences, also for a specialised model."""
    scene = load_scene("cartpole")
    bound = trained(scene, **SMALL)
    env = ModelEnv(specialize(bound) if kind == "specialized" else bound, terminal=learned_value(scene).double())
    start = SceneEnv(scene, seed=0).reset(TensorDict(batch_size=[1]))
    actions = torch.zeros(1, 4, 1, dtype=torch.float64, requires_grad=True)

    def total(sequence: torch.Tensor) -> torch.Tensor:
        states, rewards = env.imagine(start, sequence)
        assert torch.allclose(rewards.sum().double(), 0.9**4 * env.terminal(states[:, -1]).sum(), rtol=1e-5)
        return env.terminal(states[:, -1]).sum()

    (found,) = torch.autograd.grad(total(actions), actions)
    eps = 1e-4
    for t in range(4):
        step = torch.zeros_like(actions)
        step[0, t] = eps
        difference = (total(actions.detach() + step) - total(actions.detach() - step)) / (2 * eps)
        torch.testing.assert_close(found[0, t, 0], difference.detach(), rtol=1e-3, atol=1e-6)
    (by_env,) = torch.autograd.grad(env.imagine(start, actions)[1].sum(), actions)
    torch.testing.assert_close(by_env, 0.9**4 * found, rtol=1e-3, atol=1e-6)


def test_ilqg_expands_a_learned_value_through_the_learned_model():
    """The gradient of its quadratic model equals the gradient of the discounted return; its plan improves it."""
    scene = load_scene("cartpole")
    env = ModelEnv(specialize(trained(scene, **SMALL)), make_reward("balance", scene), terminal=learned_value(scene))
    planner = ILQGPlanner(env, 5, iterations=3, control_cost=0.0, seed=0)
    start = SceneEnv(scene, seed=0).reset(TensorDict(batch_size=[1]))
    solver = ILQGSolver(planner.plant(), RewardExpansion(planner._plan_reward, None, None), control_cost=0.0)
    controls = 0.3 * np.random.default_rng(0).standard_normal((1, 5, 1))
    trajectory = solver.follow(start["state"].reshape(1, -1).numpy()[0], controls)
    gradient = solver.expand(trajectory)[1].control_gradient()
    actions = torch.from_numpy(solver.actions(controls)).requires_grad_()
    total = env.imagine(start, actions)[1].sum()
    (expected,) = torch.autograd.grad(total, actions)
    half = 0.5 * (scene.action_high - scene.action_low)
    np.testing.assert_allclose(-gradient, half * expected[0].numpy(), rtol=2e-2, atol=2e-3)
    assert trajectory.cost == pytest.approx(-total.item(), rel=1e-4)
    assert solver.improve(trajectory, 3).cost < trajectory.cost


@pytest.fixture(scope="module")
def posing():
    """A model of JACO with a terminal reward of its whole pose, and starts with targets."""
    scene = load_scene("jaco")
    reward = make_reward("full_pose", scene)
    env = ModelEnv(specialize(trained(scene, **SMALL)), reward, terminal=TerminalReward(reward, scene, 30.0))
    start = SceneEnv(scene, seed=0).reset(TensorDict(batch_size=[3]))
    targets = SceneEnv(scene, seed=1).reset(TensorDict(batch_size=[3]))["state"]
    return env, start.set("task", reward.task_of(start["state"], targets))


@pytest.mark.slow
def test_a_terminal_reward_is_that_of_staying_at_the_target_s_distance(posing):
    env, start = posing
    actions = 0.1 * torch.ones(3, 4, 9)
    states, found = env.imagine(start, actions)
    plain = ModelEnv(env.predictor, env.reward).imagine(start, actions)[1]
    rest = torch.zeros(3, 9)
    staying = [env.reward(states[:, t], rest, states[:, t], start["task"]) for t in (0, -1)]
    torch.testing.assert_close(found[:, :-1], plain[:, :-1])
    torch.testing.assert_close(found[:, -1].double(), plain[:, -1].double() + 30 * staying[1])
    totals, now = 0.0, env.reset(start, set_state=True).update(start.select("task"))
    for action in actions.unbind(1):
        stepped = env.step(now.set("action", action))["next"]
        totals, now = totals + stepped["reward"], stepped.exclude("reward").update(start.select("task"))
    torch.testing.assert_close(totals.double(), found.sum(1).double() - 30 * staying[0], rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_planners_read_the_target_of_a_terminal_reward(posing):
    """Every row has its own target: iLQG's costs are the returns that the model imagines for the row."""
    env, start = posing
    planner = ILQGPlanner(env, 3, iterations=2, seed=0)
    both = planner.plan(start.clone())
    solver = ILQGSolver(
        planner.plant(), RewardExpansion(planner._plan_reward, start["task"][1], None), control_cost=0.0
    )
    trajectory = solver.follow(start["state"][1].flatten().numpy(), solver.controls(both[1:2].numpy()))
    expected = env.imagine(start[1:2], both[1:2])[1].sum()
    assert trajectory.cost == pytest.approx(-expected.item(), rel=1e-4)
    planner = GradientPlanner(env, 3, iterations=3, warm_up=20, samples=4, seed=0)
    actions = planner.decide(start.clone())[1]["plan"]["actions"]
    assert bool(actions.isfinite().all()) and not torch.equal(actions[0], actions[1])


def test_what_does_not_fit_is_refused_by_name():
    with pytest.raises(ValueError, match="weight must be above 0 and finite, got 0"):
        TerminalReward(quadratic, load_scene("pendulum"), 0)  # pyright: ignore
    scene = load_scene("pendulum")
    with pytest.raises(ValueError, match="StateValue has learned no value yet"):
        SceneEnv(scene, terminal=StateValue(scene))
    with pytest.raises(ValueError, match="scene 'cartpole', whose bodies are not those of 'pendulum'"):
        SceneEnv(scene, terminal=learned_value(load_scene("cartpole")))
    with pytest.raises(ValueError, match=r"steps of 20 ms, scene 'pendulum' has 40 ms: load it with timestep=0\.02"):
        SceneEnv(load_scene("pendulum", timestep=0.04), terminal=learned_value(scene))
    with pytest.raises(TypeError, match="terminal= must be a function of states"):
        SceneEnv(scene, terminal=3.0)  # pyright: ignore
    swimmer = load_scene("swimmer6")
    with pytest.raises(ValueError, match="does not read the target"):
        SceneEnv(swimmer, make_reward("reach", swimmer), terminal=nothing)
    bad = CostToGo(3, 1.0)
    bad.discount = 1.1
    with pytest.raises(ValueError, match="discount of terminal= must be above 0"):
        scene_env(bad)
    with pytest.raises(ValueError, match=r"terminal value must be \[8, 1\]"):
        planned("gn", lambda state: state[..., 0, 0])
    with pytest.raises(ValueError, match="returned NaN for a finite state"):
        planned("gn", lambda state: nothing(state) * torch.nan)
