"""Graph networks over flat observations: folding is exact, statistics leave padding out, weights are shared."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_gn.policies import ObservationNetwork
from torchrl_gn.scenes import ObservationGraph


@pytest.fixture
def make_network(transitions):
    def make(graph: ObservationGraph, *, seed: int = 0, actions: bool = True, **options) -> ObservationNetwork:
        torch.manual_seed(seed)
        small = {"latent": 4, "hidden": (8, 8), "mlp_hidden": (8, 8)}
        network = ObservationNetwork(graph, 5, actions=actions, **(small | options)).double()
        network.update_normalizers(*transitions(graph)[:2])
        return network

    return make


@pytest.mark.parametrize("core", ["gn", "mlp"])
@pytest.mark.parametrize("actions", [True, False])
@pytest.mark.parametrize("name", ["swimmer3", "branching"])
def test_folded_is_plain(observation_graphs, make_network, transitions, name, actions, core):
    graph = observation_graphs[name]
    observation, action, _ = transitions(graph, 6, seed=1)
    leaves = [observation.view(2, 3, -1), *([action.view(2, 3, -1)] if actions else [])]
    found = []
    for plain in (False, True):
        network = make_network(graph, actions=actions, core=core, plain=plain)
        inputs = [leaf.clone().requires_grad_() for leaf in leaves]
        out = network(*inputs)
        assert out.shape == (2, 3, graph.num_nodes, 5)
        weight = torch.linspace(-1, 1, out.numel(), dtype=out.dtype).view_as(out)
        found.append([out, *torch.autograd.grad((weight * out.sin()).sum(), [*inputs, *network.parameters()])])
    for folded, plain in zip(*found, strict=True):
        torch.testing.assert_close(folded, plain, rtol=1e-10, atol=1e-10)
        assert folded.abs().max() > 1e-6


def test_statistics_are_numpys_over_the_real_entries(observation_graphs, make_network, transitions):
    graph = observation_graphs["branching"]
    network = make_network(graph)
    observation, action, _ = (part.numpy() for part in transitions(graph))
    slots, both = graph.node_entries, np.concatenate((observation, action), axis=1)
    at_joints = np.where(graph.node_actions < 0, -1, graph.node_actions + graph.num_observations)
    columns = np.concatenate((slots, at_joints), axis=1).T
    split, normalizers = graph.num_node_features, (network.node_normalizer, network.edge_normalizer)
    for index, column in enumerate(columns):
        values = both[:, column[column >= 0]]
        normalizer, at = (normalizers[0], index) if index < split else (normalizers[1], index - split)
        assert normalizer.count[at] == values.size * (1 if index < split else 2)  # a joint is two edges
        np.testing.assert_allclose(normalizer.mean[at], values.mean(), rtol=1e-12)
        np.testing.assert_allclose(normalizer.std[at], values.std(), rtol=1e-12)
    np.testing.assert_allclose(network.global_normalizer.std, observation[:, 8:].std(0), rtol=1e-12)


def test_padding_is_zero_and_everything_real_is_normalised(observation_graphs, make_network, transitions):
    graph = observation_graphs["branching"]
    network = make_network(graph)
    dynamic = network.dynamic_graph(*transitions(graph)[:2])
    there = torch.as_tensor(graph.node_entries >= 0)
    assert (dynamic.nodes[:, ~there[:, :3]] == 0).all() and (dynamic.nodes[:, there[:, :3]] != 0).all()
    assert torch.equal(dynamic.edges[:, 0::2], dynamic.edges[:, 1::2])
    real = torch.cat((there[graph.moved, 3:], torch.as_tensor(graph.node_actions >= 0)[graph.moved]), 1)
    assert ((dynamic.edges[:, 0::2] != 0) == real).all()
    everything = [dynamic.nodes[:, there[:, 0], 0], dynamic.edges[:, 0::2][:, real[:, 1], 1]]
    assert all(abs(part.mean()) < 1e-12 and abs(part.var(correction=0) - 1) < 1e-12 for part in everything)


def test_other_graphs_are_refused_where_weights_do_not_fit(observation_graphs, make_network):
    swimmer, branching = observation_graphs.values()
    with pytest.raises(ValueError, match=r"reads \(3, 1, 1, 2\) features, graph 'branching' has \(3, 2, 2, 2\)"):
        make_network(swimmer).for_graph(branching)
    with pytest.raises(
        ValueError, match="tied to graphs of 3 nodes and 2 joints, 'swimmer4' has 4 and 3. Use core='gn'"
    ):
        make_network(swimmer, core="mlp").for_graph(ObservationGraph.swimmer(4))
    shown, longer = (graph.description() | {"identity": True} for graph in (swimmer, ObservationGraph.swimmer(4)))
    network = make_network(ObservationGraph.from_description(shown))
    with pytest.raises(ValueError, match="tied to graphs of 3 nodes"):
        network.for_graph(ObservationGraph.from_description(longer))
    with pytest.raises(ValueError, match="both show identities, or neither"):
        network.for_graph(swimmer)
    loose = swimmer.description() | {"observation": {"joints": 1, "to_target": 2, "body_velocities": 9}}
    loose |= {part: loose[part][:1] for part in ("joints", "actions")}
    with pytest.raises(ValueError, match="of 3 nodes and 2 joints, 'swimmer3' has 3 and 1"):
        make_network(swimmer, core="mlp").for_graph(ObservationGraph.from_description(loose))


def test_an_unknown_core_is_refused(observation_graphs, make_network):
    with pytest.raises(ValueError, match="core='cnn' is not known; use 'gn' or 'mlp'"):
        make_network(observation_graphs["swimmer3"], core="cnn")
