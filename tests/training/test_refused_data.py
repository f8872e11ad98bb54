"""Calls that raise leave networks and statistics as they were, so that a corrected call gives its own numbers."""

from __future__ import annotations

import functools
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

import torchrl_gn as gn
from torchrl_gn.data import trajectory_buffer
from torchrl_gn.objectives import ForwardModelLoss, SeveralScenesLoss
from torchrl_gn.policies import Agent, GraphStatePolicy, StateFeatures, StatePolicy, StateReward, StateValue
from torchrl_gn.scenes import ObservationGraph
from torchrl_gn.training import fit_policy, fit_reward, fit_value, load_pretrained

NAN = float("nan")


def contents(*modules: nn.Module) -> list[Tensor]:
    return [each.clone() for module in modules for each in (*module.parameters(), *module.buffers())]


def check_unchanged(call: Callable[[], object], *modules: nn.Module, match: str) -> None:
    before = contents(*modules)
    with pytest.raises(ValueError, match=match):
        call()
    assert all(torch.equal(one, other) for one, other in zip(before, contents(*modules), strict=True))


@pytest.fixture(scope="module")
def rows(trajectories) -> TensorDict:
    torch.manual_seed(0)
    state, action = trajectories["state"], trajectories["action"]
    after = {"state": state[:, 1:], "reward": torch.randn(*action.shape[:2], 1)}
    return TensorDict({"state": state[:, :-1], "action": action, "next": after}, action.shape[:2])


def with_entry(data: TensorDict, key, change: Callable[[Tensor], Tensor]) -> TensorDict:
    return data.clone().set(key, change(data[key].clone()))


REWARD, STATE, AFTER = ("next", "reward"), "state", ("next", "state")


@pytest.mark.parametrize(
    ("key", "change", "options", "match"),
    [
        (REWARD, lambda each: each.expand(*each.shape[:-1], 2), {}, "rewards must be"),
        (REWARD, lambda each: each * NAN, {}, "nan at index"),
        (AFTER, lambda each: each.flip(0), {}, "does not start where step"),
        (AFTER, lambda each: each[..., :1, :], {}, "next states must be"),
        (STATE, lambda each: each[..., :1, :], {}, "must be"),
        (None, None, {"lr": -1.0}, "lr=-1.0 must be positive"),
        (None, None, {"seed": -1}, "seed=-1 must be"),
        (None, None, {"steps": 1.5}, "steps=1.5 must be a whole number"),
    ],
)
def test_a_value_is_not_fitted_to_refused_episodes(scene, rows, key, change, options, match):
    value = StateValue(scene, hidden=[8])
    wrong = rows if key is None else with_entry(rows, key, change)
    options = {"iterations": 1, "steps": 2} | options
    check_unchanged(lambda: fit_value(value, wrong, **options), value, match=match)


@pytest.mark.parametrize(
    ("options", "match"), [({"lr": 0.0}, "lr=0.0 must be positive"), ({"seed": -1}, "seed"), ({"steps": 0}, "steps=0")]
)
def test_policies_and_rewards_are_not_fitted_with_refused_options(scene, rows, trajectories, options, match):
    policy, reward = StatePolicy(scene, hidden=[8]), StateReward(scene, hidden=[8])
    data = TensorDict({**trajectories.select("state", "action"), "reward": rows[REWARD]}, trajectories.shape)
    check_unchanged(lambda: fit_policy(policy, rows, **{"steps": 2, **options}), policy, match=match)
    check_unchanged(lambda: fit_reward(reward, data, **{"steps": 2, **options}), reward, match=match)
    if "steps" in options:
        check_unchanged(lambda: fit_reward(reward, data, steps=2, batch_size=0), reward, match="batch_size=0 must be")
        wide = with_entry(data, "action", lambda each: each.expand(-1, -1, 2))
        check_unchanged(lambda: fit_reward(reward, wide, steps=2), reward, match=r"action must be \[K, T, 1\]")


@pytest.mark.parametrize("kind", [StatePolicy, GraphStatePolicy])
def test_an_actor_critic_keeps_its_scales(rows, kind):
    trained = load_pretrained("pendulum")
    scene = trained.scene()
    env = gn.ModelEnv(gn.specialize(trained.bind(scene)), gn.make_reward("balance", scene))
    policy, value = kind(scene, hidden=[8]), StateValue(scene, hidden=[8], discount=0.9)
    loss, states = gn.SHACLoss(policy, value, env, steps=2), rows[STATE].flatten(0, 1)
    loss.fit_normalizers(states, rows[REWARD].flatten(0, 1))
    for state, reward, match in (
        (states + 1, torch.full((3, 1), NAN), "nan at index"),
        (states + 1, 1e200 * torch.arange(3.0, dtype=torch.double).unsqueeze(1), "too large"),
        (states + 1, torch.zeros(0, 1), "at least one"),
        (states + 1, torch.zeros(3, 2), r"must be \[\*B, 1\]"),
        (states * NAN, None, "nan at index"),
        (states[:0], None, "There is no state"),
    ):
        check_unchanged(functools.partial(loss.fit_normalizers, state, reward), policy, value, match=match)


def test_features_that_are_refitted_in_vain_keep_their_statistics(scene, rows):
    features = StateFeatures(scene)
    features.fit(rows[STATE])
    check_unchanged(lambda: features.refit(rows[STATE] * NAN), features, match="NaN or Inf")


@pytest.mark.parametrize("which", [0, 1, 2])
def test_an_agent_s_statistics_are_of_whole_transitions(which):
    torch.manual_seed(0)
    agent = Agent(ObservationGraph.swimmer(3), policy="graph", hidden=[8], model="gn")
    given = [torch.randn(20, 13), torch.rand(20, 2), torch.randn(20, 13)]
    agent.update_normalizers(*given)
    given[which] = given[which] * NAN
    check_unchanged(lambda: agent.update_normalizers(*given), agent, match="NaN or Inf")


def test_a_model_of_several_scenes_is_fitted_to_all_or_to_none():
    torch.manual_seed(0)
    scenes = [gn.load_scene(name) for name in ("pendulum", "cartpole")]
    model = gn.ForwardModel.for_scene(scenes, hidden=8, layers=1)
    loss = SeveralScenesLoss([ForwardModelLoss(model.bind(scene), noise=0.1) for scene in scenes])
    batches = [trajectory_buffer(gn.collect_trajectories(scene, 4, 9), batch_size=30).sample() for scene in scenes]
    wrong = [batches[0], with_entry(batches[1], "action", lambda each: each * NAN)]
    check_unchanged(lambda: loss.fit_normalizers(wrong), loss, match="nan at index")
    huge = [batches[0], with_entry(batches[1], STATE, lambda each: each * 1e200)]
    check_unchanged(lambda: loss.fit_normalizers(huge), loss, match="too large")
    check_unchanged(lambda: loss.fit_scales(huge), loss, match="too large")
    loss.fit_normalizers(batches)
    assert model.fitted


def test_a_model_is_not_fitted_before_all_is_checked(scene, trajectories, make_model):
    """The optimiser and the validation set were checked in the midst of the training."""
    model, other = make_model().bind(scene), make_model()

    def fit(**options) -> None:
        gn.fit(model, trajectories, steps=40, progress=False, **options)

    foreign = {"optimizer": lambda _: torch.optim.Adam(other.parameters())}
    check_unchanged(lambda: fit(**foreign), model.model, match="optimizer has no weight of the ForwardModel")
    short = trajectories.exclude("physics")
    short = TensorDict({"state": short["state"][:, :20], "action": short["action"][:, :19]}, short.shape)
    for validation, match in (
        (short, "rollout of 20 steps needs trajectories as long in validation=, got 19 steps: give longer"),
        (with_entry(trajectories, "state", lambda each: each * NAN), "not finite"),
        (with_entry(trajectories, "action", lambda each: each.expand(-1, -1, 2)), "Actions must be"),
        (gn.collect_trajectories("acrobot", 2, 20), "States of scene 'pendulum' must be"),
    ):
        check_unchanged(lambda v=validation: fit(validation=v), model.model, match=match)
