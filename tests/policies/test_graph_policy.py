"""A policy that is a graph network: where its actions are read, and that bodies of any length share it."""

from __future__ import annotations

import pytest
import torch

from torchrl_gn.policies import GraphPolicy
from torchrl_gn.scenes import ObservationGraph


@pytest.fixture
def make_policy(transitions):
    def make(graph: ObservationGraph, **options) -> GraphPolicy:
        torch.manual_seed(0)
        policy = GraphPolicy(graph, **({"latent": 4, "hidden": (8,)} | options)).double()
        policy.update_normalizers(transitions(graph)[0])
        return policy

    return make


def test_every_action_is_read_at_the_node_that_its_joint_moves(observation_graphs, make_policy, transitions):
    graph = observation_graphs["branching"]
    policy, observation = make_policy(graph), transitions(graph, 6, seed=1)[0].view(2, 3, -1)
    loc, scale = policy(observation)
    out = policy.network(observation)  # location of a node's two actions, then their scale
    places = [(2, 1), (3, 0), (2, 0)]  # the leg's are [2, 0], the foot's is [1]
    for action, (node, slot) in enumerate(places):
        expected = policy.extract(out[..., node, [slot, 2 + slot]])
        torch.testing.assert_close((loc[..., action], scale[..., action]), tuple(x.squeeze(-1) for x in expected))


def test_actions_follow_the_numbers_that_they_are_declared_with(make_policy, transitions):
    graph = ObservationGraph.swimmer(4)
    policy, observation = make_policy(graph), transitions(graph, 5, seed=1)[0]
    order = [2, 0, 1]
    declared = graph.description()
    pairs = zip(declared["actions"], order, strict=True)
    declared["actions"] = [[before, after, [number]] for (before, after, _), number in pairs]
    other = policy.for_graph(ObservationGraph.from_description(declared))
    for own, moved in zip(policy(observation), other(observation), strict=True):
        torch.testing.assert_close(moved[:, order], own, rtol=1e-13, atol=1e-14)


def test_swimmers_of_all_lengths_share_the_weights(make_policy, transitions):
    short, long = ObservationGraph.swimmer(3), ObservationGraph.swimmer(6)
    policy = make_policy(short)
    longer = policy.for_graph(long)
    observation = transitions(long, 5, seed=1)[0]
    before = longer(observation)[0]
    assert before.shape == (5, 5)
    with torch.no_grad():
        for weight in policy.parameters():
            weight += 0.1
    assert not torch.equal(longer(observation)[0], before)
    fresh = GraphPolicy(long, latent=4, hidden=(8,)).double()
    fresh.load_state_dict(policy.state_dict())
    assert torch.equal(fresh(observation)[0], longer(observation)[0])


@pytest.mark.parametrize("least", [0.01, 0.3])
def test_scales_have_a_floor(make_policy, transitions, least):
    graph = ObservationGraph.swimmer(3)
    policy, observation = make_policy(graph, min_scale=least), 1e3 * transitions(graph, 200)[0]
    for weight in policy.parameters():
        weight.data.mul_(10)
    scale = policy(observation)[1].detach()
    assert float(scale.min()) == pytest.approx(least) and scale.max() > 10


def test_a_body_without_motors_has_no_policy():
    graph = ObservationGraph("falling", {"x": 2}, {"body": ("x",)}, {})
    with pytest.raises(ValueError, match="Graph 'falling' has no actions for a policy to choose"):
        GraphPolicy(graph)
