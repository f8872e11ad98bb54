"""Plans that a policy proposes."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.modules import ProbabilisticActor, TanhNormal

from torchrl_gn.data import collect_trajectories
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.planners import GradientPlanner, ILQGPlanner
from torchrl_gn.planners.proposal import propose
from torchrl_gn.policies import StatePolicy
from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import load_scene

from ..sizes import SMALL
from .test_gradient_planner import HORIZON, at, best_gains, point_env, returns, trained
from .test_terminal import scene_env

GAIN = torch.from_numpy(best_gains()[0])


def policy_of(act) -> TensorDictModule:
    return TensorDictModule(act, ["state"], ["action"])


OPTIMAL = policy_of(lambda state: -(state[..., 1, [0, 7]] @ GAIN.to(state).mT).float())
BAD = policy_of(lambda state: torch.full((*state.shape[:-2], 1), 20.0))


def gradient_planner(proposal=None, **options) -> GradientPlanner:
    options = {"iterations": 1, "warm_up": 0, "samples": 4, "seed": 0, **options}
    return GradientPlanner(point_env(20.0), HORIZON, proposal=proposal, **options)


def test_a_policy_is_followed_through_the_model():
    env, start = point_env(20.0), at(1.0, -0.5)
    actions = propose(OPTIMAL, env, start, HORIZON)
    states, _ = env.imagine(start, actions)
    followed = OPTIMAL(TensorDict({"state": states[:, :-1]}, [2, HORIZON]))["action"]
    torch.testing.assert_close(actions, followed)
    assert list(start.keys()) == ["state"]


def test_a_good_proposal_is_the_first_plan_and_a_bad_one_is_not():
    start = at(1.0, -0.5)
    expected = propose(OPTIMAL, point_env(20.0), start, HORIZON)
    torch.testing.assert_close(gradient_planner(OPTIMAL)(start.clone())["action"], expected[:, 0])
    random = gradient_planner()(start.clone())["action"]
    assert not torch.allclose(random, expected[:, 0])
    assert not (gradient_planner(BAD)(start.clone())["action"] == 20).any()
    only = gradient_planner(BAD, samples=1)(start.clone())["action"]
    torch.testing.assert_close(only, torch.full((2, 1), 20.0))


@pytest.mark.parametrize("candidates", [1, 4])
def test_it_replaces_a_worse_plan_at_a_later_step_if_asked(candidates):
    start, options = at(1.0, -0.5), {"candidates": candidates, "shrink": 1.0}
    expected = propose(OPTIMAL, point_env(20.0), start, HORIZON)[:, 0]
    for always in (False, True):
        planner = gradient_planner(OPTIMAL, propose_every_step=always, **options)
        planner.initial_plan = lambda entries: torch.zeros(2, candidates, HORIZON, 1)  # a poor start
        planner(now := start.clone())
        action = planner(now)["action"]
        close = (action - expected).abs() < 0.05 * expected.abs()
        assert bool(close.all()) == always
    # Where it is worse than the plan, the plan stays.
    gradient_planner(OPTIMAL, **options)(now := start.clone())
    kept = gradient_planner(BAD, propose_every_step=True, **options)(now)["action"]
    assert (kept < 10).all()


def test_ilqg_starts_from_it_on_the_true_physics():
    start = scene_env().reset(TensorDict(batch_size=[3]))
    options = {"iterations": 1, "warm_up": 0, "control_cost": 0.0, "seed": 0}
    env = scene_env()
    expected = propose(OPTIMAL, env, start, HORIZON)
    planner = ILQGPlanner(env, HORIZON, proposal=OPTIMAL, **options)
    torch.testing.assert_close(planner.plan(start).float(), expected)
    assert not torch.allclose(ILQGPlanner(env, HORIZON, **options).plan(start).float(), expected)
    # Later, the better of plan and proposal is improved.
    rest = planner(start.clone())
    rest["plan", "actions"].fill_(20.0)
    for always, better in ((False, False), (True, True)):
        later = ILQGPlanner(env, HORIZON, proposal=OPTIMAL, propose_every_step=always, **options)
        later.iterations = 0
        assert torch.allclose(later.plan(rest).float(), expected) == better


@pytest.mark.slow
def test_a_learned_policy_proposes_through_learned_models_without_exploring():
    scene = load_scene("cartpole")
    seen = collect_trajectories(scene, 4, 10, seed=0)
    torch.manual_seed(0)
    policy = StatePolicy(scene, hidden=(8,))
    policy.features.fit(seen["state"])
    for options in ({}, {"core": "recurrent", "hidden_state": [4, 4, 4]}):
        env = ModelEnv(trained(scene, **SMALL, **options), make_reward("balance", scene), seed=0)
        start = SceneEnv(scene, seed=0).reset(TensorDict(batch_size=[2])).select("state")
        planner = GradientPlanner(env, 5, warm_up=0, samples=1, proposal=policy, seed=0)
        torch.testing.assert_close(planner(start.clone())["action"], policy.act(start["state"]).detach())
    noisy = TensorDictModule(lambda state: (state[..., 0, :1].float(), torch.ones(2, 1)), ["state"], ["loc", "scale"])
    actor = ProbabilisticActor(noisy, in_keys=["loc", "scale"], distribution_class=TanhNormal)
    first, again = (propose(actor, env, start, 3) for _ in range(2))
    assert torch.equal(first, again)


def test_better_by_the_model_than_random_samples():
    env, start = point_env(20.0), at(1.0, -0.5)
    planner = gradient_planner(OPTIMAL)
    action = planner(start)["action"]
    sequence = torch.cat((action[:, None], start["plan", "actions"][:, 0, :-1]), dim=1)
    best = propose(OPTIMAL, env, start.select("state"), HORIZON)
    torch.testing.assert_close(returns(env, start, sequence), returns(env, start, best))


def test_bad_policies_are_refused_by_name():
    scene = load_scene("pendulum")
    with pytest.raises(TypeError, match="proposal= must be a TensorDict module that writes 'action', got function"):
        gradient_planner(lambda state: state)
    with pytest.raises(ValueError, match="StatePolicy has learned no policy yet"):
        gradient_planner(StatePolicy(scene))
    cart = scene_env().scene
    longer = dataclasses.replace(cart, substeps=2 * cart.substeps)
    for learned, message in (
        (scene, "is of scene 'pendulum', whose bodies"),
        (longer, r"steps of 200 ms, .* has 100 ms"),
    ):
        other = StatePolicy(learned)
        other.features.update(at(1.0, 0.5)["state"])
        with pytest.raises(ValueError, match=f"StatePolicy .*{message}"):
            ILQGPlanner(scene_env(), HORIZON, proposal=other)
    with pytest.raises(ValueError, match="propose_every_step=True needs a policy"):
        ILQGPlanner(scene_env(), HORIZON, propose_every_step=True)
    with pytest.raises(ValueError, match=r"reads \['observation'\], which ModelEnv\('cart'\) does not predict"):
        gradient_planner(TensorDictModule(torch.nn.Linear(3, 1), ["observation"], ["action"]))
    with pytest.raises(ValueError, match=r"must write actions \[2, 1\], got \[2, 3\]"):
        gradient_planner(policy_of(lambda state: state[..., 1, :3]))(at(1.0, 0.5))
    with pytest.raises(ValueError, match="proposal=: 'action' has nan"):
        gradient_planner(policy_of(lambda state: state[..., 1, :1] * torch.nan))(at(1.0, 0.5))
