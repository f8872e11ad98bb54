"""The speed benchmark: its methods, baselines and bound."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch

from _speed.baselines import MuJoCoBaseline, make_baselines
from _speed.measure import Method, Workload, measure
from _speed.table import Bound, report
from torchrl_gn.data import Simulator, sample_start_states
from torchrl_gn.dynamics import ForwardModel, specialize
from torchrl_gn.dynamics.executors import EXECUTORS
from torchrl_gn.networks import GNCore, Graph, GraphSize
from torchrl_gn.scenes import load_scene


def test_every_executor_is_a_way(load, compose, monkeypatch):
    recipe = load("benchmarks/speed")
    scene = load_scene("pendulum")
    model = ForwardModel.for_scene(scene, hidden=4)
    monkeypatch.setitem(EXECUTORS, "another", EXECUTORS["eager"])
    methods = recipe.make_methods(compose("benchmarks/speed", "compile=false"), model, "pendulum", None)
    assert {"reference", "specialised", "specialised, fast", "another"} <= set(methods) and "compiled" not in methods
    assert methods["another"].model.executor_name == "another" and next(iter(methods)) == "reference"


@pytest.mark.parametrize(
    ("names", "error", "match"),
    [(["graph"], ValueError, "not known; use any of"), (["jraph"], ImportError, r"pip install 'jax\[cpu\]' jraph")],
)
def test_what_baselines_need(compose, monkeypatch, names, error, match):
    monkeypatch.setitem(sys.modules, "jax", None)
    monkeypatch.delitem(sys.modules, "_common.jraph_network", raising=False)
    scene = load_scene("pendulum")
    with pytest.raises(error, match=match):
        make_baselines(compose("benchmarks/speed"), ForwardModel.for_scene(scene, hidden=4), scene, names)


def test_mujoco_baseline_simulates_the_scene():
    scene = load_scene("pendulum")
    state, actions = torch.zeros(3, scene.num_nodes, 13), 0.1 * torch.randn(3, 4, scene.num_actions)
    baseline = MuJoCoBaseline(scene, seed=5)
    start = sample_start_states(scene, 3, 5)
    expected = Simulator(scene, num_threads=1).rollout(torch.from_numpy(start), actions)["physics"].numpy()
    found = baseline.rollout(state, actions)()[0][:, scene.substeps - 1 :: scene.substeps]
    assert np.array_equal(found[..., 1:], expected[:, 1:, 1:])  # but for the time
    assert np.array_equal(baseline.step(state, actions[:, 0])()[0][:, -1, 1:], expected[:, 1, 1:])


def test_bound_is_the_slower_of_products_and_weights():
    bound = Bound(flop=1e6, rate=1e9, size=4e6, bandwidth=1e9)
    assert [bound.milliseconds(batch) for batch in (1, 4, 10)] == pytest.approx([4, 4, 10])
    scene = load_scene("pendulum")
    small, large = (
        Bound.measure(specialize(ForwardModel.for_scene(scene, hidden=hidden).bind(scene)), 1) for hidden in (8, 16)
    )
    assert 0 < small.size < large.size < 4 * small.size and small.rate > 0 and small.bandwidth > 0


def test_others_are_timed_in_turn_and_compared(capsys, monkeypatch):
    order = []

    def take(seconds):
        return lambda *_: (order.append(seconds), seconds)[1]

    monkeypatch.setattr("_speed.measure.timed", lambda run, fast: (None, run()))
    methods = {name: Method(name) for name in ("reference", "method")}  # type: ignore[arg-type]
    workload = Workload("step, batch 1", take(0.03), 2, 3, {"jraph": take(0.008)})
    measure([workload], methods)
    # Two calls each to warm up, three turns, in which the shorter workload is called twice, and one for memory.
    assert order == [0.03] * 4 + [0.008] * 2 + [0.03, 0.03, 0.008, 0.008] * 3 + [0.03, 0.03, 0.008]
    assert workload.milliseconds == {"reference": [15] * 3, "method": [15] * 3, "jraph": [4] * 3}
    workload.milliseconds = {"reference": [8.0], "method": [1.0], "jraph": [4.0]}
    metrics = report([workload], {("step, batch 1", "method"): 0.5})
    row = {key: metrics[f"step, batch 1/method/{key}"] for key in ("milliseconds", "speedup", "jraph", "bound")}
    assert row == {"milliseconds": 1, "speedup": 8, "jraph": 4, "bound": 0.5}
    assert "step, batch 1/jraph/bound" not in metrics and "8.0" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("activation", ["relu", "silu", "gelu", "tanh"])
def test_jraph_network_is_ours(activation):
    pytest.importorskip("jraph")
    from _common.jraph_network import JraphNetwork, batched

    torch.manual_seed(0)
    sizes = {"hidden": [16, 8], "edge_hidden": [12], "latent": 6}
    core = GNCore(GraphSize(3, 2, 1), GraphSize(2, 4, 3), 5, activation=activation, **sizes)
    edge_index = torch.tensor([[0, 1, 1, 2, 3], [1, 0, 2, 1, 0]])
    parts = [torch.randn(6, *shape) for shape in ((4, 5), (5, 6), (4,))]
    nodes, edges, globals_ = (part.requires_grad_() for part in parts)
    expected = core(Graph(nodes, edges, globals_, edge_index)).nodes
    gradient = torch.randn_like(expected)
    expected.backward(gradient)

    network = JraphNetwork(core)
    graph = batched(Graph(nodes.detach(), edges.detach(), globals_.detach(), edge_index))
    torch.testing.assert_close(torch.from_numpy(np.array(network.predict(graph))).view(6, 4, 5), expected.detach())
    gradients = network.gradient(graph, gradient.flatten(0, 1).numpy())
    for found, wanted in zip(gradients, (nodes.grad, edges.grad), strict=True):
        assert wanted is not None
        torch.testing.assert_close(torch.from_numpy(np.array(found)).view_as(wanted), wanted, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_samples_with_parameters_of_their_own(load, compose):
    recipe = load("benchmarks/speed")
    batches = ["batches=[1,3]", "rollout_batches=[2]", "step_gradient_batches=[]", "gradient_batches=[1]"]
    sizes = ["hidden=[8,8]", "latent=6", "activation=silu", "compile=false", "own_parameters=true", "system=pendulum"]
    cfg = compose("benchmarks/speed", *sizes, *batches)
    model, transitions = recipe.make_model(cfg, "pendulum", [8, 8])
    parameters = recipe.variants_parameters(cfg, model)
    assert parameters.shape == (3,)
    methods = recipe.make_methods(cfg, model.requires_grad_(False), "pendulum", parameters)
    state, action = transitions["state"][:3], transitions["action"][:3]
    expected = methods["reference"].model.step(state, action)[0]
    alone = methods["native"].model.step(state[:1], action[:1])[0]
    torch.testing.assert_close(methods["native"].model.step(state, action)[0], expected, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(alone, expected[:1], rtol=1e-5, atol=1e-6)
    own = model.bind(load_scene("pendulum")).step(state, action)[0]
    assert (own - expected).abs().max() > 1e-5
    with pytest.raises(ValueError, match="leave out baselines or own_parameters"):
        recipe.variants_parameters(compose("benchmarks/speed", *sizes, "baselines=[mujoco]"), model)
