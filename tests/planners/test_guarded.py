"""A guarded policy hands over where its ensemble doubts."""

from __future__ import annotations

import dataclasses
from typing import Any, cast

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from torchrl_gn.data import log_trajectories, log_tree, simulate_log, trajectory_buffer
from torchrl_gn.dynamics import Ensemble, ForwardModel
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.planners import GradientPlanner, Guarded, PlanAhead
from torchrl_gn.policies import StatePolicy
from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import load_scene, with_factors


def constant(value: float) -> TensorDictModule:
    return TensorDictModule(lambda state: torch.full((*state.shape[:-2], 6), value), ["state"], ["action"])


def test_the_fallback_acts_where_the_ensemble_doubts(ensemble, scenes, random_states):
    states = random_states(scenes["cheetah"], 6)
    doubt = ensemble.doubt(states, torch.full((6, 6), 0.5)).detach()
    trust = float(doubt.median())
    states[1, 2, 8] = torch.nan  # nothing is known of what is not finite
    policy = Guarded(constant(0.5), constant(-1.0), ensemble, trust=trust)
    found = policy(TensorDict({"state": states}, [6]))
    handed = ~(ensemble.doubt(states, torch.full((6, 6), 0.5)) <= trust)
    assert handed[1] and handed.any() and not handed.all()
    assert torch.equal(found["guarded"].squeeze(-1), handed)
    assert torch.equal(found["action"], torch.where(handed[:, None], -1.0, 0.5).expand(6, 6))
    assert torch.equal(found["doubt"][0], doubt[:1])


def test_it_guards_a_planner_in_an_environment(ensemble, scenes):
    reward = make_reward("forward", scenes["cheetah"])
    planner = GradientPlanner(ModelEnv(ensemble, reward), 3, 2, samples=4, seed=0)
    env = SceneEnv(scenes["cheetah"], reward, seed=0).append_transform(planner.make_tensordict_primer())
    for trust, guarded in ((1e9, False), (1e-9, True)):
        policy = Guarded(planner, constant(0.0), ensemble, trust=trust)
        assert {"action", "guarded"} <= set(policy.out_keys) and "state" in policy.in_keys
        played = env.rollout(3, policy)
        assert bool((played["guarded"] == guarded).all()) and "plan" in played.keys()
        assert bool((played["action"] == 0).all()) == guarded


def test_past_actions_are_those_executed():
    log = simulate_log(load_scene("acrobot"), 2, 20, 0)
    tree = cast(Any, log_tree(log, "double", commands=[[0], []], history=2))
    data, _ = log_trajectories(log, 10, history=2)
    members = [ForwardModel.for_scene(tree, hidden=[4]) for _ in range(2)]
    for member in members:
        ForwardModelLoss(member.bind(tree)).fit_normalizers(trajectory_buffer(data, batch_size=20, seed=0).sample())
    made = Ensemble(members)
    size = (1, len(members[0].layout.names))
    made.calibration.set(torch.ones(size), torch.zeros(size), torch.full(size[1:], 0.01))
    env = ModelEnv(made.bind(tree), lambda s, a, n, t: n[..., 1, :1], start_states=data["state"].flatten(0, 1), seed=0)
    still = TensorDictModule(lambda state: torch.full((*state.shape[:-2], 1), 0.25), ["state"], ["action"])
    for trust in (1e9, 1e-9):
        planner = GradientPlanner(env, 3, 1, samples=4, seed=0)
        found = Guarded(planner, still, made.bind(tree), trust=trust)(env.reset(TensorDict(batch_size=[2])))
        assert torch.equal(found["next", "past_actions"][:, 0], found["action"])
        assert bool((found["action"] == 0.25).all()) == (trust < 1)


def test_two_planners_would_share_a_plan(ensemble, scenes):
    env = ModelEnv(ensemble, make_reward("forward", scenes["cheetah"]))
    planners = [GradientPlanner(env, 3, 2, samples=4, seed=seed) for seed in range(2)]
    for fallback in (planners[1], PlanAhead(planners[1])):
        with pytest.raises(ValueError, match="would share the entry 'plan': GradientPlanner and"):
            Guarded(planners[0], fallback, ensemble, trust=1)


def test_a_model_or_policy_of_another_robot_is_refused(ensemble, scenes):
    """Its sizes may be the same."""
    cheetah = scenes["cheetah"]
    renamed, jointed = (
        dataclasses.replace(cheetah, name="other", **{part: tuple(f"its {name}" for name in getattr(cheetah, part))})
        for part in ("node_names", "joint_names")
    )
    heavy = with_factors(cheetah, {"body_mass": ["torso"]}, [2.0])
    env = ModelEnv(ensemble, make_reward("forward", cheetah))
    for other, kind in ((renamed, "bodies"), (jointed, "joints"), (heavy, None)):
        torch.manual_seed(0)
        policy = StatePolicy(other, hidden=(4,))
        policy.features.update(torch.as_tensor(other.reference_state)[None].expand(2, -1, -1))
        uses = (
            lambda policy=policy: Guarded(policy, constant(0.0), ensemble, trust=1),
            lambda policy=policy: Guarded(constant(0.0), policy, ensemble, trust=1),
            lambda policy=policy: GradientPlanner(env, 3, 2, samples=4, proposal=policy),
        )
        for use in uses:
            if kind is None:
                use()
                continue
            with pytest.raises(ValueError, match=f"StatePolicy is of scene 'other', whose {kind} are not those"):
                use()


def test_what_cannot_guard_is_refused(ensemble, scenes, make_model):
    with pytest.raises(ValueError, match=r"trust=0 must be positive"):
        Guarded(constant(0.0), constant(0.0), ensemble, trust=0)
    with pytest.raises(TypeError, match="fallback must be a TensorDict module that writes 'action', got Linear"):
        Guarded(constant(0.0), torch.nn.Linear(2, 2), ensemble, trust=1)
    plain = Ensemble([make_model(scenes["cheetah"], seed=seed) for seed in range(2)]).bind(scenes["cheetah"])
    with pytest.raises(RuntimeError, match="not calibrated"):
        Guarded(constant(0.0), constant(0.0), plain, trust=1)
