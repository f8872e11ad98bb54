"""Planning by sampling against the known optimum, the average by hand, and a policy's proposals."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import StepCounter

from torchrl_gn.dynamics import specialize
from torchrl_gn.envs import ModelEnv, SceneEnv, batched
from torchrl_gn.planners import SamplingPlanner, TerminalReward
from torchrl_gn.policies import StatePolicy, StateValue
from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import load_scene

from ..sizes import SMALL
from .test_gradient_planner import HORIZON, Point, at, best_actions, cart, point_env, quadratic, returns, trained
from .test_proposal import BAD, OPTIMAL


def planner_of(**options) -> SamplingPlanner:
    return SamplingPlanner(point_env(20.0), HORIZON, seed=0, **options)


def test_it_comes_near_the_optimum():
    start = at(1.0, -0.5)
    planner = planner_of(iterations=20, samples=200, elites=20, min_std=0.01, temperature=0.5)
    planned = planner(start.clone())
    best = torch.cat([best_actions(1.0), best_actions(-0.5)]).reshape(2, HORIZON, 1)
    goal = returns(point_env(20.0), start, best)
    found = planner.improve(start, torch.zeros(2, 1, HORIZON, 1), {}, resumed=False)[0]
    reached = returns(point_env(20.0), start, planner.actions(found[:, 0]))
    nothing = returns(point_env(20.0), start, torch.zeros(2, HORIZON, 1))
    assert (goal - reached <= 0.02 * (goal - nothing)).all()
    torch.testing.assert_close(planned["action"].double(), best[:, 0], rtol=0.1, atol=0.3)


def improved(env: ModelEnv, start: TensorDict, plan: torch.Tensor, **options) -> np.ndarray:
    """The planner's mean sequence after two iterations from another, seed 0."""
    planner = SamplingPlanner(env, HORIZON, iterations=2, seed=0, **options)
    return planner.improve(start, plan, {}, resumed=True)[0][0, 0].double().numpy()


def by_hand(plan: torch.Tensor, samples: int, returns: list[Callable], average: Callable) -> np.ndarray:
    """The same for one row, with the returns of each iteration and an average of sequences by returns."""
    mean, std = plan[0, 0].double().numpy(), 0.5
    noise = np.random.default_rng(0).standard_normal((2, 1, samples, HORIZON, 1))[:, 0]
    for each, of in zip(noise, returns, strict=True):
        each[0] = 0
        sequences = np.clip(mean + std * each, -1, 1)
        mean, std = average(sequences, of(sequences), mean)
    return mean


def test_the_average_is_that_of_the_best_by_hand():
    env, start, plan = point_env(20.0), at(1.0), torch.full((1, 1, HORIZON, 1), 0.1)

    def of(sequences: np.ndarray) -> np.ndarray:
        actions = 20 * torch.from_numpy(sequences)
        return returns(env, at(*[1.0] * len(actions)), actions).numpy()

    def average(sequences: np.ndarray, value: np.ndarray, _) -> tuple[np.ndarray, np.ndarray]:
        best = np.argsort(-value)[:3]
        weight = np.exp((value[best] - value.max()) / (0.7 * value[best].std()))
        mean = np.average(sequences[best], 0, weight)
        return mean, np.maximum(np.sqrt(np.average((sequences[best] - mean) ** 2, 0, weight)), 0.02)

    found = improved(env, start, plan, samples=5, elites=3, temperature=0.7, min_std=0.02)
    np.testing.assert_allclose(found, by_hand(plan, 5, [of, of], average), rtol=1e-4, atol=1e-5)


def test_integers_of_numpy_are_whole_numbers():
    counts = {"iterations": 2, "samples": 6, "elites": 3, "proposals": 2, "proposal": OPTIMAL}
    given = {name: count if name == "proposal" else np.int64(count) for name, count in counts.items()}
    usual, found = (planner_of(**options)(at(1.0, -0.5))["action"] for options in (counts, given))
    assert torch.equal(found, usual)


@pytest.mark.parametrize("diverged", [[3], [0, 1, 2, 3]])
def test_equal_and_diverged_returns_do_no_harm(diverged):
    """In the first iteration some returns are not finite, or all; in the second they are equal but for one."""
    rows = iter([diverged, [0]])

    def constant(state, action, next_state, task):
        reward = torch.zeros(*state.shape[:-2], 1)
        reward[next(rows)] = -torch.inf
        return reward

    def average(sequences: np.ndarray, finite: list[int], mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        best = sequences[finite]
        return (best.mean(0), np.maximum(best.std(0), 0.05)) if finite else (mean, np.full_like(mean, 0.5))

    env, plan = ModelEnv(Point(cart(20.0)), constant), torch.full((1, 1, HORIZON, 1), 0.3)
    left = [[each for each in range(4) if each not in bad] for bad in (diverged, [0])]
    wanted = by_hand(plan, 4, [lambda _, finite=finite: finite for finite in left], average)
    np.testing.assert_allclose(improved(env, at(1.0), plan, samples=4, elites=3), wanted, rtol=1e-4, atol=1e-5)


def test_a_plan_goes_on_from_the_last_one():
    planner, start = planner_of(iterations=1, samples=1, elites=1), at(1.0)  # the only sample is the mean
    plan = torch.rand(1, 1, HORIZON, 1) - 0.5
    entry = {"actions": plan, "planned": torch.ones(1, 1, dtype=torch.bool), "time": torch.zeros(1, 1).double()}
    planned = planner(start.clone().set("plan", TensorDict(entry, [1])))
    torch.testing.assert_close(planned["action"], plan[:, 0, 0])
    torch.testing.assert_close(planned["plan", "actions"], torch.cat((plan[:, :, 1:], plan[:, :, -1:]), 2))
    alone = planner(start.clone())
    assert float(alone["action"]) == 0


def test_a_good_policy_is_followed_and_a_bad_one_is_not():
    start = at(1.0, -0.5)
    followed = OPTIMAL(start.clone())["action"]
    given = {"iterations": 1, "samples": 2, "elites": 1}
    near = planner_of(proposal=OPTIMAL, proposals=1, **given)(start.clone())["action"]
    torch.testing.assert_close(near, followed)
    far = planner_of(proposal=BAD, samples=64, elites=4, iterations=4)(start.clone())["action"]
    assert (far.abs() < 10).all()


def test_proposals_have_the_policys_noise_but_the_first():
    scene, reward = load_scene("pendulum"), None
    reward = make_reward("balance", scene)
    env, policy = ModelEnv(specialize(trained(scene, **SMALL)), reward), StatePolicy(scene, hidden=(8,))
    start = SceneEnv(scene, reward, seed=0).reset(TensorDict(batch_size=[3])).select("state")
    policy.features.fit(start["state"])
    planner = SamplingPlanner(env, 4, proposal=policy, proposals=5, seed=0)
    proposed = planner.proposed_plans(start, 5, explore=True)
    assert proposed.shape == (3, 5, 4, 1)
    torch.testing.assert_close(planner.actions(proposed[:, 0, 0]), policy.act(start["state"]))
    assert (proposed[:, 1:, 0] != proposed[:, :1, 0]).all()
    with pytest.raises(TypeError, match="must be a TensorDict module that writes 'action'"):
        SamplingPlanner(env, 4, proposal=lambda state: state)
    with pytest.raises(ValueError, match="'other'"):
        SamplingPlanner(env, 4, proposal=TensorDictModule(torch.nn.Identity(), ["other"], ["action"]))


def test_the_value_of_the_last_state_counts():
    far = {"iterations": 8, "samples": 64, "elites": 8}
    env = ModelEnv(point_env(20.0).world_model, quadratic, terminal=lambda state: 1e3 * state[..., 1, :1])
    torch.testing.assert_close(
        SamplingPlanner(env, 4, seed=0, **far)(at(0.0))["action"], torch.full((1, 1), 20.0), rtol=0.1, atol=0.0
    )


def test_policy_and_value_of_a_longer_control_step_plan_in_the_model():
    scene = load_scene("pendulum")
    coarse, reward = load_scene("pendulum", timestep=2 * scene.timestep), make_reward("balance", scene)
    policy, value = StatePolicy(coarse, hidden=(8,)), StateValue(coarse, discount=0.9, hidden=(8,))
    true_env = SceneEnv(coarse, make_reward("balance", coarse), seed=0)
    start = true_env.reset(TensorDict(batch_size=[2]))
    policy.features.fit(start["state"])
    value.features.fit(start["state"])
    value.normalizer.update(-torch.rand(100, 1))
    env = ModelEnv(specialize(trained(scene, **SMALL)), reward, terminal=value, action_repeat=2)
    planner = SamplingPlanner(env, 3, samples=8, elites=4, proposal=policy, proposals=4, seed=0)
    assert true_env.rollout(3, planner, tensordict=start, auto_reset=False)["action"].shape == (2, 3, 1)
    with pytest.raises(ValueError, match="scene 'pendulum' has 20 ms"):
        ModelEnv(env.world_model, reward, terminal=value)


def test_seeds_and_collectors():
    scene = load_scene("pendulum")
    reward = make_reward("balance", scene)
    imagined = ModelEnv(specialize(trained(scene, **SMALL)), reward)
    options = {"horizon": 3, "samples": 8, "elites": 4}
    start = SceneEnv(scene, reward, seed=0).reset(TensorDict(batch_size=[2])).select("state")
    first, again, other = (
        SamplingPlanner(imagined, seed=seed, **options)(start.copy())["action"] for seed in (0, 0, 1)
    )
    torch.testing.assert_close(first, again, rtol=0, atol=0)
    assert (first != other).all()
    planner = SamplingPlanner(imagined, seed=0, **options)
    limited = batched(SceneEnv(scene, reward, seed=0), 2).append_transform(StepCounter(3))
    sizes = {"frames_per_batch": 12, "total_frames": 12, "auto_register_policy_transforms": True}
    for data in Collector(limited, planner, **sizes):
        assert data["plan", "actions"].shape == (2, 6, 1, 3, 1)


def test_a_plan_of_an_earlier_episode_does_not_count():
    scene = load_scene("pendulum")
    reward = make_reward("balance", scene)
    env = SceneEnv(scene, reward, seed=0)
    planner = SamplingPlanner(
        ModelEnv(specialize(trained(scene, **SMALL)), reward), 4, samples=1, elites=1, iterations=1
    )
    now, chosen = env.reset(TensorDict(batch_size=[1])), torch.full((1, 1, 4, 1), 0.5)
    for carried, wanted in ((0.0, 0.5), (1.0, 0.0)):  # seconds in 'physics' when the plan was made
        entry = {"actions": chosen, "planned": torch.ones(1, 1, dtype=torch.bool)}
        entry["time"] = torch.full((1, 1), carried - scene.timestep).double()
        assert float(planner(now.copy().set("plan", TensorDict(entry, [1])))["action"]) == pytest.approx(wanted)


def test_a_plan_of_before_torchrls_tracker_said_that_an_episode_begins_does_not_count():
    planner = planner_of(samples=1, elites=1, iterations=1)
    entry = {"actions": torch.full((2, 1, HORIZON, 1), 0.5), "planned": torch.ones(2, 1, dtype=torch.bool)}
    now = at(1.0, -0.5).set("plan", TensorDict(entry, [2])).set("is_init", torch.tensor([[True], [False]]))
    action = planner(now)["action"].flatten()
    assert action[0] == 0 and action[1] != 0


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16])
def test_a_planner_of_another_dtype_keeps_that_of_actions(dtype):
    planned = planner_of(samples=4, elites=2).to(dtype)(at(1.0, -0.5))
    assert planned["action"].dtype == planned["plan", "actions"].dtype == torch.float32


def test_where_all_diverge_the_last_plan_is_kept():
    def infinite(state, action, next_state, task):
        return quadratic(state, action, next_state, task) - torch.inf

    planner = SamplingPlanner(ModelEnv(point_env(20.0).world_model, infinite), 3, samples=4, seed=0)
    with pytest.warns(RuntimeWarning, match="every imagined rollout of 2 of 2 states"):
        planned = planner(at(1.0, 2.0))
    assert (planned["action"] == 0).all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        planner_of(samples=4)(at(1.0))


def test_ensembles_are_planned_on_cautiously(ensemble, scenes, random_states):
    scene = scenes["cheetah"]
    env = ModelEnv(specialize(ensemble, executor="eager"), make_reward("forward", scene))
    start = TensorDict({"state": random_states(scene, 2, scale=0.1)}, [2])
    planner = SamplingPlanner(env, 4, pessimism=1.0, samples=32, elites=8, seed=0)
    nothing = torch.zeros(2, 1, 4, scene.num_actions)
    found = planner.improve(start, nothing, {}, resumed=False)[0]
    assert (planner.predicted_returns(start, found) > planner.predicted_returns(start, nothing)).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"samples": 0}, "samples=0 must be a whole number, 1 or more"),
        ({"elites": 2.5}, "elites=2.5 must be a whole number"),
        ({"proposals": 0}, "proposals=0 must be"),
        ({"iterations": 0}, "iterations=0 must be"),
        ({"std": 0.01}, "min_std=0.05 must be above 0, and std=0.01 finite and at least that"),
        ({"temperature": 0.0}, "temperature=0.0 must be positive"),
        ({"action_cost": -1.0}, "action_cost=-1.0 must be finite"),
        ({"pessimism": 1.0}, "needs an ensemble"),
    ],
)
def test_bad_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        planner_of(**options)


def test_it_plans_in_a_model_alone():
    scene = load_scene("pendulum")
    with pytest.raises(TypeError, match="SamplingPlanner needs a ModelEnv, of a learned model; got SceneEnv"):
        SamplingPlanner(SceneEnv(scene, make_reward("balance", scene), seed=0), 3)


def test_a_target_reaches_policy_reward_and_value(scenes):
    scene = load_scene("suite:reacher/easy")
    reward = make_reward(None, scene)
    terminal = TerminalReward(reward, scene, weight=2.0)
    env = ModelEnv(specialize(trained(scene, **SMALL)), reward, terminal=terminal)
    target = torch.tensor([[0.1, 0.1, 0.01], [-0.1, 0.1, 0.01]]).double()
    start = SceneEnv(scene, seed=0).reset(TensorDict(batch_size=[2])).select("state").set("target", target)
    start["task"] = reward.task_of(start["state"], target)
    policy = StatePolicy(scene, hidden=(8,), target=True)
    policy.features.fit(start["state"], target)
    planner = SamplingPlanner(env, 3, proposal=policy, samples=16, elites=4, proposals=3, seed=0)
    swapped = start.copy().set("target", target.flip(0)).set("task", target.flip(0))
    sure = [planner.proposed_plans(each, 1) for each in (start, swapped)]
    assert (sure[0] != sure[1]).any()
    sequences = torch.rand(2, 16, 3, scene.num_actions) - 0.5
    found = [planner.predicted_returns(each.repeat_interleave(16, 0), sequences) for each in (start, swapped)]
    assert planner(start.copy())["action"].shape == (2, scene.num_actions)
    assert found[0].isfinite().all() and found[1].isfinite().all()
