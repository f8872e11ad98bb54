"""A policy that learns round by round, goes on from networks in memory, and is averaged."""

from __future__ import annotations

import copy

import pytest
import torch

import torchrl_gn as gn
from torchrl_gn.actor_critic import ActorCritic, ActorCriticTask, SuiteActorCriticTask


def weights(module: torch.nn.Module) -> torch.Tensor:
    return torch.cat([each.detach().flatten() for each in module.parameters()])


def balancing(options) -> ActorCriticTask:
    scene = gn.load_scene("pendulum")
    return ActorCriticTask(scene, options, gn.make_reward("balance", scene))


def make_task(kind: str, options) -> ActorCriticTask:
    if kind == "scene":
        return balancing(options)
    pytest.importorskip("dm_control.suite")
    return SuiteActorCriticTask("suite:cartpole/swingup", options)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["scene", "suite"])
def test_goes_on_from_what_it_had(kind, small):
    """The second round of a copy that was begun from the first round's networks, bit for bit."""
    options = small(updates=3)
    torch.manual_seed(0)
    task = make_task(kind, options)
    learner = ActorCritic([task], options)
    task.collect()
    learner.learn(0)
    task.add(task.play(learner.playing(), seed=0))

    torch.manual_seed(5)  # what a new one makes is not used
    other = make_task(kind, options)
    kept = copy.deepcopy(learner.policy), [copy.deepcopy(task.networks)]
    resumed = ActorCritic([other], options, *kept)
    resumed.load_state_dict(copy.deepcopy(learner.state_dict()))
    other.collect()
    other.add(task.data[1])
    assert torch.equal(other.data[0]["state"], task.data[0]["state"])

    found, before = [], {name: weights(network).clone() for name, network in task.networks.items()}
    for each in (learner, resumed):
        torch.manual_seed(1)
        found.append(each.learn(1))
    assert found[0] == found[1]
    assert torch.equal(weights(learner.policy), weights(resumed.policy))
    assert {*task.networks} == {*task.network_names} == {"value", "model", *(["reward"] if kind == "suite" else [])}
    for name, network in task.networks.items():
        assert torch.equal(weights(network), weights(other.networks[name])), name
        assert not torch.equal(weights(network), before[name]), name


def test_refuses_networks_without_one(small):
    task = balancing(options := small())
    networks = ActorCritic([task], options).tasks[0].networks
    del networks["value"]
    with pytest.raises(ValueError, match=r"networks= lacks \['value'\]"):
        ActorCritic([task], options, networks=[networks])


def test_averages_weights(small):
    task = balancing(options := small(average=3))
    learner = ActorCritic([task], options)
    earlier = [learner.playing() for _ in range(2)]
    with torch.no_grad():
        for number, policy in enumerate(earlier):
            for each in policy.parameters():
                each.fill_(float(number))
    mean = (weights(learner.policy) + weights(earlier[0]) + weights(earlier[1])) / 3
    torch.testing.assert_close(weights(learner.averaged(earlier)), mean)
    assert torch.equal(weights(learner.averaged([])), weights(learner.policy))
    # An eighth of the rounds so far, at most three, the last of which is the learner's own.
    assert [[*learner.averaged_rounds(index)] for index in (0, 7, 8, 15, 16, 100)] == [
        [], [], [7], [14], [14, 15], [98, 99],
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "names", "message"),
    [
        ("mlp", ["pendulum", "pendulum"], "policy=mlp must be graph to learn on several systems"),
        ("mlp", [], "must have at least one"),
    ],
)
def test_refuses_tasks_that_do_not_fit(kind, names, message, small):
    options = small(policy=kind)
    with pytest.raises(ValueError, match=message):
        ActorCritic([balancing(options) for _ in names], options)


def test_refuses_what_is_no_task_of_the_suite(small):
    with pytest.raises(ValueError, match="system='cheetah' is not a task of the suite: give 'suite:cheetah/run'"):
        SuiteActorCriticTask("cheetah", small())
