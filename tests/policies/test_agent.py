"""The networks of an agent: made alike every time, and their statistics taken once."""

from __future__ import annotations

import json

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_gn.policies import Agent
from torchrl_gn.scenes import ObservationGraph

SMALL = {"hidden": (8,), "model_options": {"latent": 4, "hidden": [8]}, "policy_options": {"latent": 4, "hidden": [8]}}
KINDS = [
    {"model": "gn", "learned_reward": True},
    {"policy": "graph", "model": "mlp", "min_scale": 0.2},
    {"stochastic": False},
]


@pytest.mark.parametrize("kind", KINDS, ids=["svg", "graph", "ddpg"])
@pytest.mark.parametrize("name", ["swimmer3", "branching"])
def test_a_description_makes_the_same_agent(observation_graphs, transitions, name, kind):
    graph = observation_graphs[name]
    agent = Agent(graph, **(SMALL | kind))
    observation, action, after = (part.float() for part in transitions(graph))
    agent.update_normalizers(observation, action, after)
    again = Agent.from_description(json.loads(json.dumps(agent.description())))
    again.load_state_dict(agent.state_dict())
    assert again.description() == agent.description()
    for each in (ExplorationType.DETERMINISTIC, ExplorationType.RANDOM):
        with set_exploration_type(each):
            found = []
            for one in (agent, again):
                torch.manual_seed(0)
                td = one.value(one.policy(TensorDict({"observation": observation}, [50])))
                found.append((td["action"], td["state_action_value"]))
        assert all(map(torch.equal, *found)) and (found[0][0].abs() < 1).all()
    if agent.model is not None and again.model is not None:
        assert torch.equal(agent.model.step(observation, action), again.model.step(observation, action))
    if agent.reward is not None and again.reward is not None:
        inputs = observation, action, after
        assert torch.equal(agent.reward(*inputs), again.reward(*inputs))


@pytest.mark.parametrize("policy", ["mlp", "graph"])
def test_a_stochastic_policy_explores_and_a_deterministic_one_does_not(observation_graphs, policy):
    graph = observation_graphs["swimmer3"]
    td = TensorDict({"observation": torch.zeros(1000, graph.num_observations)}, [1000])
    with set_exploration_type(ExplorationType.RANDOM):
        drawn = Agent(graph, policy=policy, min_scale=0.3, **SMALL).policy(td.clone())["action"]
        same = Agent(graph, stochastic=False, **SMALL).policy(td.clone())["action"]
    assert (drawn.std(0) > 0.2).all()
    torch.testing.assert_close(same, same[:1].expand_as(same))


def test_a_graph_policy_drives_bodies_of_other_lengths(observation_graphs, transitions):
    short, long = observation_graphs["swimmer3"], ObservationGraph.swimmer(6)
    agent, fresh = Agent(short, policy="graph", **SMALL), Agent(long, policy="graph", **SMALL)
    agent.update_normalizers(*transitions(short, 40))
    policy = agent.policy_for(long)
    fresh.policy.load_state_dict(agent.policy.state_dict())
    td = TensorDict({"observation": transitions(long, 20, seed=1)[0].float()}, [20])
    for each in (ExplorationType.DETERMINISTIC, ExplorationType.RANDOM):
        with set_exploration_type(each):
            found = []
            for one in (policy, fresh.policy):
                torch.manual_seed(0)
                found.append(one(td.clone())["action"])
        assert found[0].shape == (20, 5) and torch.equal(*found)
    with pytest.raises(
        ValueError, match="Only a graph network drives other bodies; build the agent with policy='graph'"
    ):
        Agent(short, **SMALL).policy_for(long)


def test_statistics_take_every_transition_once(observation_graphs, transitions):
    graph = observation_graphs["swimmer3"]
    agent = Agent(graph, policy="graph", model="gn", **SMALL)
    policy, model = agent.graph_policy, agent.model
    assert policy is not None and model is not None
    parts = transitions(graph, 40)
    for start in (0, 10):
        agent.update_normalizers(*(part[start : start + 10 + 2 * start] for part in parts))
    for network in (policy.network, model.network):
        assert torch.equal(network.node_normalizer.count, torch.full((3,), 40.0 * 3).double())
        nodes = parts[0][:, 4:].reshape(-1, 3)
        torch.testing.assert_close(network.node_normalizer.mean, nodes.mean(0), rtol=1e-12, atol=0)
        torch.testing.assert_close(network.node_normalizer.std, nodes.std(0, correction=0), rtol=1e-12, atol=0)
    change = (parts[2] - parts[0])[:, 2:4]
    torch.testing.assert_close(model.change_std[2:4], change.std(0, correction=0))


def test_bad_options_are_named(observation_graphs):
    graph = observation_graphs["swimmer3"]
    with pytest.raises(ValueError, match="policy='cnn' is not known; use 'mlp' or 'graph'"):
        Agent(graph, policy="cnn")
    with pytest.raises(ValueError, match="A graph policy is stochastic"):
        Agent(graph, policy="graph", stochastic=False)
