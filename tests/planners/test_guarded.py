"""A guarded policy hands over where its ensemble doubts."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from torchrl_gn.dynamics import Ensemble
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.planners import GradientPlanner, Guarded
from torchrl_gn.rewards import make_reward


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


def test_what_cannot_guard_is_refused(ensemble, scenes, make_model):
    with pytest.raises(ValueError, match=r"trust=0 must be positive"):
        Guarded(constant(0.0), constant(0.0), ensemble, trust=0)
    with pytest.raises(TypeError, match="fallback must be a TensorDict module that writes 'action', got Linear"):
        Guarded(constant(0.0), torch.nn.Linear(2, 2), ensemble, trust=1)
    plain = Ensemble([make_model(scenes["cheetah"], seed=seed) for seed in range(2)]).bind(scenes["cheetah"])
    with pytest.raises(RuntimeError, match="not calibrated"):
        Guarded(constant(0.0), constant(0.0), plain, trust=1)
