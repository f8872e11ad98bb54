"""The forward model of observations: symmetries, gradients, unseen inputs, and learning."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.policies import ObservationModel
from torchrl_gn.scenes import ObservationGraph

NAMES = ["swimmer3", "branching"]


@pytest.mark.parametrize("core", ["gn", "mlp"])
@pytest.mark.parametrize("name", NAMES)
def test_folded_is_plain(observation_graphs, make_observation_model, transitions, name, core):
    graph = observation_graphs[name]
    inputs = [part.requires_grad_() for part in transitions(graph, 5, seed=1)[:2]]
    models = [make_observation_model(graph, core=core, plain=plain) for plain in (False, True)]
    outs = [model.step(*inputs) for model in models]
    torch.testing.assert_close(*outs, rtol=1e-10, atol=1e-10)
    weight = torch.linspace(-1, 1, outs[0].numel(), dtype=torch.float64).view_as(outs[0])
    pairs = zip(outs, models, strict=True)
    found = [torch.autograd.grad((weight * out).sum(), [*inputs, *model.parameters()]) for out, model in pairs]
    for folded, plain in zip(*found, strict=True):
        torch.testing.assert_close(folded, plain, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", NAMES)
def test_the_prediction_is_written_and_is_what_the_outputs_say(
    observation_graphs, make_observation_model, transitions, name
):
    """Every number at its own node, globals summed over the nodes, in the scale of changes."""
    graph = observation_graphs[name]
    model = make_observation_model(graph, observation_key=("seen", "flat"), action_key="push")
    observation, action, _ = transitions(graph, 4, seed=1)
    td = model(TensorDict({"seen": {"flat": observation}, "push": action}, [4]))
    out = model.network(observation, action)
    expected, slots = observation.clone(), graph.node_entries.shape[1]
    for node, entries in enumerate(graph.node_entries.tolist()):
        for slot, entry in enumerate(entries):
            if entry >= 0:
                expected[:, entry] += model.change_normalizer.inverse(out[:, node, :slots])[:, slot]
    summed = out[..., slots:].sum(1)
    expected[:, graph.global_entries] += model.global_change_normalizer.inverse(summed)
    torch.testing.assert_close(td["next", "seen", "flat"], expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_gradients_are_finite_differences(observation_graphs, make_observation_model, transitions, name):
    graph = observation_graphs[name]
    model = make_observation_model(graph)
    inputs = [part.requires_grad_() for part in transitions(graph, 2, seed=1)[:2]]
    assert torch.autograd.gradcheck(model.step, inputs)
    assert torch.autograd.functional.jacobian(model.step, tuple(inputs))[1].abs().sum() > 0


def test_the_order_that_nodes_are_declared_in_does_not_matter(make_observation_model, transitions):
    graph = ObservationGraph.swimmer(5)
    model = make_observation_model(graph)
    declared = graph.description()
    declared["nodes"] = {name: declared["nodes"][name] for name in sorted(declared["nodes"], reverse=True)}
    declared["joints"] = declared["joints"][2:] + declared["joints"][:2]
    other = ObservationGraph.from_description(declared)
    assert other.node_names != graph.node_names
    inputs = transitions(graph, 7, seed=1)[:2]
    torch.testing.assert_close(model.for_graph(other).step(*inputs), model.step(*inputs), rtol=1e-12, atol=1e-12)


def test_changes_have_numpys_statistics_over_the_real_entries(observation_graphs, make_observation_model, transitions):
    graph = observation_graphs["branching"]
    model = make_observation_model(graph)
    observation, _, after = transitions(graph)
    change = after - observation
    for index, column in enumerate(graph.node_entries.T):
        values = change[:, column[column >= 0]]
        torch.testing.assert_close(model.change_normalizer.mean[index], values.mean(), rtol=1e-12, atol=0)
        torch.testing.assert_close(model.change_std[column[column >= 0][0]], values.std(correction=0))
    torch.testing.assert_close(model.change_std[8:], change[:, 8:].std(0, correction=0))


def test_what_never_changed_stays_and_what_always_changed_alike_goes_on(observation_graphs, transitions):
    graph = observation_graphs["branching"]
    torch.manual_seed(0)
    model = ObservationModel(graph, latent=4, hidden=(8,)).double()
    observation, action, after = transitions(graph)
    after[:, 4] = observation[:, 4]  # of the torso's velocity
    after[:, 9] = observation[:, 9] + 0.25  # half of the goal
    model.update_normalizers(observation, action, after)
    assert (model.change_std == 0).nonzero().flatten().tolist() == [4, 9]
    observation, action, _ = transitions(graph, seed=1)
    predicted = model.step(observation, action) - observation
    assert (predicted[:, 4] == 0).all() and (predicted[:, [0, 1, 2, 3, 5, 6, 7, 8]].std(0) > 1e-3).all()
    torch.testing.assert_close(predicted[:, 9], torch.full((50,), 0.25).double(), rtol=1e-12, atol=1e-12)


def test_graphs_of_other_sizes_share_weights_and_statistics(make_observation_model, transitions):
    short, long = ObservationGraph.swimmer(3), ObservationGraph.swimmer(6)
    model = make_observation_model(short)
    longer = model.for_graph(long)
    assert dict(longer.named_parameters()).keys() == dict(model.named_parameters()).keys()
    inputs = transitions(long, 5, seed=1)[:2]
    before = longer.step(*inputs)
    small, large = transitions(short, 5, seed=1)[:2], model.step(*transitions(short, 5, seed=1)[:2])
    optimizer = torch.optim.SGD(model.parameters(), lr=0.1)
    model.step(*small).square().mean().backward()
    optimizer.step()
    assert not torch.equal(longer.step(*inputs), before)
    assert torch.equal(longer.step(*inputs), model.for_graph(long).step(*inputs))
    assert torch.equal(longer.for_graph(short).step(*small), model.step(*small))
    assert not torch.equal(model.step(*small), large)
    longer.update_normalizers(*transitions(long, seed=2))
    assert model.change_normalizer.count[0] == 50 * (3 + 6)


def test_casts_leave_statistics_alone(observation_graphs, make_observation_model, transitions):
    graph = observation_graphs["branching"]
    exact, quick = make_observation_model(graph), make_observation_model(graph).float()
    observation, action, _ = transitions(graph, 5, seed=1)
    assert torch.equal(quick.change_normalizer.mean, exact.change_normalizer.mean)
    expected = exact.step(observation, action) - observation
    for dtype in (torch.float32, torch.float64):
        predicted = quick.step(observation.to(dtype), action.to(dtype))
        assert predicted.dtype == dtype
        torch.testing.assert_close(predicted.double() - observation, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("core", ["gn", "mlp"])
def test_it_learns_a_linear_system(core):
    """Two masses on springs, the second pushed: errors of one step, against predicting the mean change."""
    graph = ObservationGraph(
        "springs",
        {"x": 2, "v": 2},
        {"a": ("x[0]", "v[0]"), "b": ("x[1]", "v[1]")},
        {("a", "b"): ()},
        actions={("a", "b"): (0,)},
        identity=True,
    )
    torch.manual_seed(0)
    model = ObservationModel(graph, core=core, latent=8, hidden=(16,), mlp_hidden=(32,))
    x, v, u = torch.randn(300, 2), torch.randn(300, 2), torch.randn(300, 1)
    acceleration = -x + 0.5 * x.flip(-1) + torch.tensor([0.0, 1.0]) * u
    observation = torch.cat((x, v), -1)
    after = torch.cat((x + 0.1 * v, v + 0.1 * acceleration), -1)
    model.update_normalizers(observation, u, after)

    def error() -> torch.Tensor:
        return ((model.step(observation, u) - after) / model.change_std.float()).square().mean()

    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)
    for _ in range(150):
        optimizer.zero_grad()
        error().backward()
        optimizer.step()
    assert error() < 0.02  # 1 of the mean change


def test_wrong_shapes_are_named(observation_graphs, make_observation_model, transitions):
    model = make_observation_model(observation_graphs["swimmer3"])
    observation, action, _ = transitions(observation_graphs["swimmer3"], 4)
    with pytest.raises(ValueError, match=r"Observations of 'swimmer3' must be \[\*B, 13\], got \[4, 12\]"):
        model.step(observation[:, 1:], action)
    for wrong in (action[:, 1:], action[:2], action.unsqueeze(0)):
        with pytest.raises(
            ValueError, match=r"Actions of 'swimmer3' must be \[4, 2\] to go with observations \[4, 13\]"
        ):
            model.step(observation, wrong)
    with pytest.raises(ValueError, match="NaN or Inf"):
        model.update_normalizers(observation, action, observation * torch.nan)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    for inputs, what in (
        ((observation[:, :1], action, observation[:, :1]), "Observations of 'swimmer3' must be"),
        ((observation, action[:, :1], observation), "Actions of 'swimmer3' must be"),
        ((observation, action, observation[:1]), r"Next observations must be \[4, 13\] as observations, got \[1, 13\]"),
    ):
        with pytest.raises(ValueError, match=what):
            model.update_normalizers(*inputs)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    with pytest.raises(KeyError, match='"action" not found'):
        model(TensorDict({"observation": observation}, [4]))
