"""Plans in an ensemble: lower bounds of returns, and ends where the members are not to be trusted."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import step_mdp

from torchrl_gn.dynamics import Ensemble, specialize
from torchrl_gn.dynamics.ensemble import lower_bound
from torchrl_gn.envs import ModelEnv
from torchrl_gn.planners import GradientPlanner
from torchrl_gn.rewards import make_reward

BATCH, HORIZON = 2, 4
OPTIONS = {"horizon": HORIZON, "candidates": 2, "samples": 4, "seed": 0}


@pytest.fixture
def reward(scenes):
    return make_reward("forward", scenes["cheetah"])


@pytest.fixture
def start(scenes, random_states) -> TensorDict:
    return TensorDict({"state": random_states(scenes["cheetah"], BATCH, scale=0.1)}, [BATCH])


@pytest.fixture
def plan(scenes) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    shape = BATCH, OPTIONS["candidates"], HORIZON, scenes["cheetah"].num_actions
    return 2 * torch.rand(shape, generator=generator) - 1


def repeated(start: TensorDict) -> TensorDict:
    return start.repeat_interleave(OPTIONS["candidates"], 0)


@pytest.mark.parametrize("pessimism", [0.0, 1.5, -1.0])
def test_returns_are_the_mean_of_the_members_less_their_spread(ensemble, reward, start, plan, pessimism):
    starts, plan = repeated(start), plan.requires_grad_()
    members = [GradientPlanner(ModelEnv(each, reward), action_cost=0.1, **OPTIONS) for each in ensemble.members]
    returns = torch.stack([planner.predicted_returns(starts, plan) for planner in members])
    planner = GradientPlanner(ModelEnv(ensemble, reward), action_cost=0.1, pessimism=pessimism, **OPTIONS)
    found, wanted = planner.predicted_returns(starts, plan), returns.mean(0) - pessimism * returns.std(0)
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(*(torch.autograd.grad(each.sum(), plan)[0] for each in (found, wanted)))


def test_plans_improve_the_lower_bound(ensemble, reward, start):
    env = ModelEnv(specialize(ensemble, executor="eager"), reward)
    planner = GradientPlanner(env, pessimism=1.0, iterations=5, **OPTIONS)
    planned = planner(start.copy())
    assert planned["action"].shape == (BATCH, 6)
    first, later = (planner.predicted_returns(repeated(start), each) for each in _plans(planner, start))
    assert (later.amax(1) > first.amax(1)).all()


def _plans(planner: GradientPlanner, start: TensorDict) -> tuple[torch.Tensor, torch.Tensor]:
    """Candidates before and after their improvement."""
    planner.set_seed(0)
    first = planner.initial_plan(start)
    planner.set_seed(0)
    return first, planner.improve(start, first, {"step_size": torch.ones(BATCH, 1)}, resumed=False)[0]


def test_members_that_agree_have_a_gradient():
    values = torch.ones(3, 2).requires_grad_()
    bound = lower_bound(values * torch.tensor([1.0, 2.0]), 2.0)
    torch.testing.assert_close(bound.detach(), torch.tensor([1.0, 2.0]))
    (gradient,) = torch.autograd.grad(bound.sum(), values)
    torch.testing.assert_close(gradient, torch.tensor([1.0, 2.0]).expand(3, 2) / 3)


def test_a_member_that_diverges_rules_a_plan_out():
    values = torch.tensor([[1.0, -math.inf], [2.0, 3.0]]).requires_grad_()
    bound = lower_bound(values, 1.0)
    assert bound[1] == -math.inf and bound[0].isfinite()
    (gradient,) = torch.autograd.grad(bound[0], values)
    assert gradient.isfinite().all()


def test_episodes_end_where_members_disagree(ensemble, reward, start, scenes):
    scene, generator = scenes["cheetah"], torch.Generator().manual_seed(0)
    actions = 2 * torch.rand(BATCH, HORIZON, scene.num_actions, generator=generator) - 1
    with torch.no_grad():
        states = ModelEnv(ensemble, reward).imagine(start, actions)[0]
        doubts = ensemble.doubt(states[:, :-1], actions)
    trust = float(doubts[:, 0].min()) + 1e-6  # of one episode the first step is still to be trusted
    env = ModelEnv(ensemble, reward, trust=trust, unstable_reward=-7.0)
    found, now, rewards, ended = env.imagine_steps(start, actions), start.copy(), [], []
    for t in range(HORIZON):
        stepped = env.step(now.set("action", actions[:, t]))
        rewards.append(stepped["next", "reward"])
        ended.append(stepped["next", "terminated"])
        now = step_mdp(stepped, keep_other=True)
    alive = ~torch.stack(ended, 1)
    before = torch.cat([torch.ones_like(alive[:, :1]), alive[:, :-1]], 1).cumprod(1).bool()
    torch.testing.assert_close(found.rewards, torch.stack(rewards, 1).where(before, 0.0))
    assert torch.equal(found.alive[:, :-1], before)
    first = (doubts > trust).long().argmax(1)
    assert (doubts > trust).any(1).all() and first.max() > 0
    assert (found.rewards[torch.arange(BATCH), first] == -7.0).all() and (found.rewards == -7.0).sum() == BATCH


def test_a_doubted_step_costs_one_step_of_each_member(ensemble, reward, start, scenes, calls):
    env = ModelEnv(ensemble, reward, trust=1.0)
    action = torch.zeros(BATCH, scenes["cheetah"].num_actions)
    stepped = calls(type(ensemble.members[0]), "step")
    env.step(start.set("action", action))
    assert len(stepped) == len(ensemble.members)


def test_what_needs_an_ensemble_says_so(ensemble, reward, scenes, make_model):
    one = ModelEnv(ensemble.members[0], reward)
    with pytest.raises(ValueError, match=r"pessimism=1\.0 needs an ensemble"):
        GradientPlanner(one, pessimism=1.0, **OPTIONS)
    with pytest.raises(ValueError, match="pessimism=nan must be finite"):
        GradientPlanner(ModelEnv(ensemble, reward), pessimism=math.nan, **OPTIONS)
    with pytest.raises(ValueError, match=r"trust=2\.0 needs a model with doubt"):
        ModelEnv(ensemble.members[0], reward, trust=2.0)
    with pytest.raises(ValueError, match="trust=0 must be positive"):
        ModelEnv(ensemble, reward, trust=0)
    plain = Ensemble([make_model(scenes["cheetah"], seed=seed) for seed in range(2)]).bind(scenes["cheetah"])
    with pytest.raises(RuntimeError, match="not calibrated"):
        ModelEnv(plain, reward, trust=2.0)
