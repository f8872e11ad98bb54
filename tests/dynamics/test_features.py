"""Features and cores of one's own in a forward model, and its description."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import ClassVar, Literal

import pytest
import torch
from torch import Tensor, nn

from torchrl_gn.data import collect_trajectories, trajectory_buffer
from torchrl_gn.dynamics import BodyState, Controls, Feature, ForwardModel, JointAxes, specialize
from torchrl_gn.dynamics.bound import dynamic_graph
from torchrl_gn.dynamics.features import FEATURES, StepInputs
from torchrl_gn.networks import CORES, Core, GNCore, Graph, GraphSize
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import ParameterNames, load_scene

from ..sizes import SMALL


@dataclass(frozen=True)
class Speed(Feature):
    """Magnitude of each body's velocity, to a power."""

    part: ClassVar[Literal["nodes", "edges"]] = "nodes"

    power: int = 1

    def size(self, layout) -> int:
        return 1

    def bind(self, scene, layout, canonicalizer) -> nn.Module:
        return _BoundSpeed(self.power, layout.slices["linear_velocity"])


class _BoundSpeed(nn.Module):
    def __init__(self, power: int, where: slice) -> None:
        super().__init__()
        self.power, self.where = power, where

    def forward(self, inputs: StepInputs) -> Tensor:
        velocity = inputs.canonical.state[..., self.where]
        return velocity.square().sum(-1, keepdim=True).add(1e-6).sqrt() ** self.power


class ScaledCore(Core):
    """Core of one linear map per node, without an ``nn.Linear``."""

    def __init__(self, dynamic: GraphSize, static: GraphSize, out_nodes: int, *, scale: float = 1.0) -> None:
        super().__init__(dynamic)
        self.scale, size = scale, (dynamic + static).nodes
        self.weight = nn.Parameter(torch.randn(size, out_nodes) / size**0.5)

    def forward(self, graph: Graph) -> Graph:
        return Graph(self.scale * graph.nodes @ self.weight, graph.edges, graph.globals_, graph.edge_index)


def again(model: ForwardModel) -> ForwardModel:
    """The model from its description, as a checkpoint has it."""
    other = ForwardModel.from_description(json.loads(json.dumps(model.description())))
    other.load_state_dict(model.state_dict())
    assert other.description() == model.description()
    return other


def assert_predicts_alike(model: ForwardModel, scene, state, action) -> None:
    expected = model.bind(scene, reference=True).step(state, action)[0]
    for predictor in (model.bind(scene), specialize(model.bind(scene)), again(model).bind(scene)):
        torch.testing.assert_close(predictor.step(state, action)[0], expected, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_a_feature_of_ones_own_is_seen_and_described(scenes, fit, random_states, random_actions, monkeypatch):
    scene = scenes["swimmer6"]
    state, action = random_states(scene, 5), random_actions(scene, 5)
    features = (Speed(power=2), BodyState(), Controls(), JointAxes())
    torch.manual_seed(0)
    model = fit(ForwardModel.for_scene(scene, features=features, **SMALL), scene)
    usual = ForwardModel.for_scene(scene, features=features[1:], **SMALL)
    assert model.dynamic_size == usual.dynamic_size + GraphSize(1, 0, 0)
    shown = dynamic_graph(model.bind(scene), state, action).nodes[..., 0]
    square = state[..., 7:10].square().sum(-1).add(1e-6)
    normalizer = model.node_normalizer
    torch.testing.assert_close(shown, ((square - normalizer.mean[0]) * normalizer.inverse_std[0]).float())
    # Components of the state are found behind it.
    assert model.state_columns()["position"].start == 1
    assert model.bind(scene).in_range(state, 10.0).all() and not model.bind(scene).in_range(1e9 * state, 10.0).any()
    with pytest.raises(ValueError, match=r"Features \['Speed'\] have no name for a checkpoint: add them to FEATURES"):
        model.description()
    monkeypatch.setitem(FEATURES, "speed", Speed)
    assert again(model).features == model.features
    assert_predicts_alike(model, scene, state, action)


def test_a_core_of_ones_own_is_used_and_described(scenes, fit, random_states, random_actions, monkeypatch):
    scene = scenes["swimmer6"]
    with pytest.raises(ValueError, match=r"core='scaled' is not known; use one of \['gn'.*, or add yours to CORES"):
        ForwardModel.for_scene(scene, core="scaled")
    monkeypatch.setitem(CORES, "scaled", ScaledCore)
    torch.manual_seed(0)
    model = fit(ForwardModel.for_scene(scene, core="scaled", scale=0.5), scene)
    assert isinstance(model.core, ScaledCore) and isinstance(again(model).core, ScaledCore)
    assert again(model).core_options == {"scale": 0.5} and again(model).core.scale == 0.5
    assert model.bind(scene).dtype == torch.float32
    assert_predicts_alike(model, scene, random_states(scene, 5), random_actions(scene, 5))
    with pytest.raises(TypeError, match=r"core ScaledCore has options \['hidden'\]; the core has \['scale'\]"):
        ForwardModel.for_scene(scene, core="scaled", hidden=8)


def test_mistakes_of_a_core_are_named(scenes, fit, random_states, random_actions, monkeypatch):
    scene = scenes["swimmer6"]

    class Careless(Core):
        def __init__(self, dynamic, static, out_nodes):
            nn.Module.__init__(self)

    class Plain(ScaledCore):
        def forward(self, graph):
            return super().forward(graph).nodes

    monkeypatch.setitem(CORES, "careless", Careless)
    with pytest.raises(TypeError, match=r"Careless.__init__ must call super\(\).__init__\(dynamic\)"):
        ForwardModel.for_scene(scene, core="careless")
    monkeypatch.setitem(CORES, "plain", Plain)
    fitted = fit(ForwardModel.for_scene(scene, core="plain"), scene)
    with pytest.raises(TypeError, match="Plain must return a Graph, not Tensor"):
        fitted.bind(scene)(random_states(scene, 2), random_actions(scene, 2))


def test_unknown_names_are_refused():
    description = ForwardModel(ParameterNames()).description()
    with pytest.raises(
        ValueError,
        match=r"feature='smell' is not known; use one of \['activations', 'actuators', .*FEATURES",
    ):
        ForwardModel.from_description({**description, "features": [{"feature": "smell"}]})
    with pytest.raises(ValueError, match="core='gone' is not known"):
        ForwardModel.from_description({**description, "core": "gone"})


def test_features_and_cores_that_do_not_fit_are_named(monkeypatch):
    scene = load_scene("pendulum")
    data = collect_trajectories(scene, 2, steps=5, seed=0)
    batch = trajectory_buffer(data, batch_size=8, seed=0).sample()

    class Short(BodyState):
        def size(self, layout):
            return 1

    class Wide(GNCore):
        def __init__(self, dynamic, static, out_nodes, **options):
            super().__init__(dynamic, static, out_nodes + 1, **options)

    with pytest.raises(ValueError, match="No feature is of edges"):
        ForwardModel.for_scene(scene, features=(BodyState(),), hidden=8)
    short = ForwardModel.for_scene(scene, features=(Short(), Controls(), JointAxes()), hidden=8)
    with pytest.raises(ValueError, match=r"Features of nodes have \d+ numbers, but their size\(\) says 1"):
        ForwardModelLoss(short.bind(scene)).fit_normalizers(batch)
    monkeypatch.setitem(CORES, "wide", Wide)
    model = ForwardModel.for_scene(scene, core="wide", hidden=8)
    loss = ForwardModelLoss(model.bind(scene))
    loss.fit_normalizers(batch)
    with pytest.raises(ValueError, match="The core must give 12 features per node, not 13"):
        model.bind(scene, reference=True).step(data["state"][:, 0], data["action"][:, 0])
