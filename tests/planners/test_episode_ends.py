"""Planners at ends of episodes: steps after the end do not count."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.planners import GradientPlanner, ILQGPlanner, PlanAhead
from torchrl_gn.planners.ilqg_solver import ILQGSolver
from torchrl_gn.planners.linearize import RewardExpansion

from .. import zoo
from .test_gradient_planner import Point, at, cart

CLIFF, HORIZON = 0.5, 8


def far(state: Tensor) -> Tensor:
    return state[..., 1, 0] > CLIFF


def place(state: Tensor, action: Tensor, next_state: Tensor, task=None) -> Tensor:
    """The further the better, and worth most beyond the cliff."""
    return next_state[..., 1, :1]


def values(state: Tensor) -> Tensor:
    return 100 + state[..., 1, :1]


def until_the_end(states: Tensor) -> Tensor:
    """Sum of :func:`place` over states ``[B, H + 1, N, 13]``, counted in a loop."""
    totals = []
    for row in states:
        total = 0.0
        for state in row[1:]:
            total += float(state[1, 0])
            if state[1, 0] > CLIFF:
                break
        totals.append(total)
    return torch.tensor(totals, dtype=torch.float64)


def model_env(**options) -> ModelEnv:
    return ModelEnv(Point(cart(20.0)), place, done=far, **options)


@pytest.mark.parametrize("as_module", [False, True])
def test_gradient_planner_scores_until_the_end(as_module):
    ends = TensorDictModule(lambda state: far(state).unsqueeze(-1), ["state"], ["terminated"]) if as_module else far
    env = ModelEnv(Point(cart(20.0)), place, done=ends)
    planner = GradientPlanner(env, HORIZON, 1, candidates=4, samples=4, action_cost=0.01, seed=0)
    plan = 2 * torch.rand(2, 4, HORIZON, 1, generator=torch.Generator().manual_seed(0)) - 0.5
    starts = at(*[0.3] * 4, *[0.0] * 4)
    states, _ = env.imagine(starts, 20 * plan.flatten(0, 1))
    ended = (states[:, 1:, 1, 0] > CLIFF).long()
    counted = (ended.cumsum(1) - ended == 0).double()
    assert 0 < counted[:, -1].sum() < 8
    effort = (counted * plan.flatten(0, 1).squeeze(-1).square()).sum(1)
    expected = (until_the_end(states) - 0.01 * effort).float()
    torch.testing.assert_close(planner.predicted_returns(starts, plan).flatten(), expected)


def test_a_sequence_that_diverges_after_the_end_is_as_good_as_another():
    class Bursts(Point):
        def forward(self, tensordict):
            out = super().forward(tensordict)
            state = out["next", "state"]
            return out.set(("next", "state"), torch.where(state[..., 1:2, :1] > CLIFF + 0.4, torch.nan, state))

    planner = GradientPlanner(ModelEnv(Bursts(cart(20.0)), place, done=far), HORIZON, 1, samples=1, seed=0)
    plan = torch.ones(1, 1, HORIZON, 1)
    states, _ = planner.imagined.imagine(at(0.3), 20 * plan[0])
    assert not states.isfinite().all()
    assert planner.predicted_returns(at(0.3), plan).isfinite().all()
    without = GradientPlanner(ModelEnv(Bursts(cart(20.0)), place), HORIZON, 1, samples=1, seed=0)
    assert without.predicted_returns(at(0.3), plan).item() == -torch.inf


def solver_of(env: SceneEnv | ModelEnv, **options) -> ILQGSolver:
    from functools import partial

    planner = ILQGPlanner(env, HORIZON, 1, seed=0)
    reward = env.reward if env.terminal is None else planner._plan_reward
    expansion = RewardExpansion(reward, None, None)  # pyright: ignore[reportArgumentType]
    return ILQGSolver(planner.plant(), expansion, count=partial(planner._count, None), **options)


def cart_env(**options) -> SceneEnv:
    return SceneEnv(zoo.load("cart"), place, done=far, **options)


def physics_at(env: SceneEnv, x: float, speed: float) -> np.ndarray:
    physics = np.zeros(env.scene.physics_size)
    physics[1], physics[2] = x, speed
    return physics


@pytest.mark.parametrize("speed", [0.1, 8.0])
def test_ilqg_costs_until_the_end_on_the_true_physics(speed):
    env = cart_env()
    solver, start = solver_of(env, control_cost=0.1), physics_at(env, 0.3, speed)
    controls = np.random.default_rng(0).uniform(-1, 1, (1, HORIZON, env.scene.num_actions))
    trajectory = solver.follow(start, controls)
    states = torch.from_numpy(trajectory.state[None])
    steps = trajectory.length
    assert (steps < HORIZON) == (speed == 8.0) and far(states[0, 1:])[:steps].sum() == (steps < HORIZON)
    cost = 0.1 * np.square(controls[0, :steps]).sum() - until_the_end(states).item()
    assert trajectory.cost == pytest.approx(cost, rel=1e-6)


def test_ilqg_expands_the_steps_until_the_end_alone():
    env = cart_env()
    solver, start = solver_of(env, control_cost=0.0), physics_at(env, 0.23, 2.0)
    controls = np.zeros((1, HORIZON, env.scene.num_actions))
    trajectory = solver.follow(start, controls)
    length = trajectory.length
    assert 1 < length < HORIZON
    gradient = solver.expand(trajectory)[1].control_gradient()
    assert gradient.shape[0] == length
    for t in range(length):
        step = np.zeros_like(controls)
        step[0, t, 0] = 1e-5
        up, down = (solver.follow(start, controls + sign * step) for sign in (1, -1))
        assert up.length == down.length == length
        assert gradient[t, 0] == pytest.approx((up.cost - down.cost) / 2e-5, rel=1e-3, abs=1e-6)
    assert solver.improve(trajectory, 5).cost <= trajectory.cost


@pytest.mark.parametrize("speed", [0.0, 2.0])
def test_ilqg_gives_no_value_to_an_ended_episode(speed):
    env = cart_env(terminal=values)
    solver, start = solver_of(env, control_cost=0.0), physics_at(env, 0.3, speed)
    trajectory = solver.follow(start, np.zeros((1, HORIZON, env.scene.num_actions)))
    states = torch.from_numpy(trajectory.state[None])
    value = float(values(states[:, -1])) if speed == 0 else 0.0
    assert trajectory.cost == pytest.approx(-until_the_end(states).item() - value, rel=1e-6)
    assert np.isfinite(solver.expand(trajectory)[1].gradient).all()


def test_ilqg_bears_a_simulation_that_blows_up_after_the_end():
    scene = zoo.load("cart", ('gear="1"', 'gear="2e10"'))  # MuJoCo gives up beyond half of it
    env = SceneEnv(scene, place, done=lambda state: state[..., 1, 0].abs() > 0.1)
    solver = solver_of(env, control_cost=0.0)
    controls = np.zeros((1, HORIZON, scene.num_actions))
    controls[0, -1] = 1.0
    start = physics_at(env, 0.3, 1.0)
    trajectory = solver.follow(start, controls)
    assert trajectory.length == 1 and np.isfinite(trajectory.cost)
    assert solver_of(SceneEnv(scene, place, done=far), control_cost=0.0).follow(start * 0, controls).cost == np.inf


def test_a_batch_of_none_has_no_action():
    env = model_env()
    none = at(*[0.0] * 2)[:0]
    planners = [GradientPlanner(env, 3, 1, samples=1, seed=0), ILQGPlanner(cart_env(), 3, 1, seed=0)]
    for planner in [*planners, *map(PlanAhead, planners)]:
        start = cart_env().reset(TensorDict(batch_size=[0])) if planner not in planners[:1] else none
        assert planner(start.clone())["action"].shape == (0, 1)
