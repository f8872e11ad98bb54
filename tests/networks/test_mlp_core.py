"""The baseline: one MLP over the flattened graph."""

from __future__ import annotations

import pytest
import torch

from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.networks import GraphSize, Incidence, MLPCore, graph_concat
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import ParameterNames, load_scene


def test_it_is_an_mlp_of_all_features(random_graph):
    torch.manual_seed(0)
    size, edge_index = GraphSize(3, 2, 1), torch.tensor([[0, 1, 2, 0], [1, 2, 0, 0]])
    core = MLPCore(size, GraphSize(0, 0, 0), 5, counts=(3, 4), hidden=(7, 6), activation="relu").double()
    graph = random_graph(size, edge_index, 3, 2)
    out = core(graph)
    assert out.nodes.shape == (2, 3, 5)
    flat = torch.cat((graph.nodes.reshape(2, 9), graph.edges.reshape(2, 8), graph.globals_), 1)
    first, second, third = core.mlp[0], core.mlp[2], core.mlp[4]
    hidden = second(first(flat).relu()).relu()
    torch.testing.assert_close(out.nodes, third(hidden).view(2, 3, 5))


@pytest.mark.parametrize("globals_", [0, 2])
def test_folding_keeps_outputs_and_gradients(random_graph, globals_):
    torch.manual_seed(0)
    dynamic_size, static_size = GraphSize(3, 2, globals_), GraphSize(4, 1, 3)
    edge_index = torch.tensor([[0, 1, 2, 0], [1, 2, 0, 0]])
    core = MLPCore(dynamic_size, static_size, 5, counts=(3, 4), hidden=(7, 6)).double()
    dynamic, static = random_graph(dynamic_size, edge_index, 3, 2), random_graph(static_size, edge_index, 3, seed=1)
    incidence = Incidence(edge_index, 3, torch.tensor([2, 1]))
    plain = core(graph_concat(dynamic, static)).nodes
    folded = core.fold(incidence, static).predict(dynamic)
    assert (folded[:, 0] == 0).all()
    torch.testing.assert_close(folded[:, 1:], plain[:, 1:])
    gradients = [torch.autograd.grad(out[:, 1:].square().sum(), list(core.parameters())) for out in (plain, folded)]
    for expected, got in zip(*gradients, strict=True):
        torch.testing.assert_close(got, expected)


@pytest.mark.slow
def test_it_learns_and_is_tied_to_its_scene(scenes, fit, random_states, random_actions):
    scene = scenes["pendulum"]
    torch.manual_seed(0)
    model = fit(ForwardModel.for_scene(scene, core="mlp", hidden=(32,)), scene)
    bound = model.bind(scene)
    state, action = random_states(scene, 64), random_actions(scene, 64)
    batch = {"state": state, "action": action, "next_state": state}
    loss, optimizer = ForwardModelLoss(bound), torch.optim.Adam(model.core.parameters(), 1e-2)
    values = []
    for _ in range(60):
        optimizer.zero_grad()
        value = loss(**batch)[0]
        value.backward()
        optimizer.step()
        values.append(float(value.detach()))
    assert values[-1] < values[0] / 3
    with pytest.raises(ValueError, match="graphs of 2 nodes and 2 edges alone; scene 'swimmer3' has 4 and 10"):
        model.bind(load_scene("swimmer3"))


def test_bad_options_are_named(scenes):
    features = ParameterNames.of(scenes["pendulum"])
    with pytest.raises(ValueError, match="MLP core needs counts"):
        ForwardModel(features, core="mlp")
    with pytest.raises(ValueError, match=r"core='transformer' is not known; use one of \['gn', 'mlp', 'recurrent'"):
        ForwardModel(features, core="transformer")
    with pytest.raises(ValueError, match="activation='sigmoid' is not known"):
        ForwardModel(features, activation="sigmoid")
    with pytest.raises(ValueError, match="needs a hidden layer"):
        ForwardModel(features, core="mlp", counts=(2, 2), hidden=())
    with pytest.raises(TypeError, match=r"nor its core GNCore has options \['skip'\]"):
        ForwardModel(features, skip=False)
