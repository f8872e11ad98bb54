"""Features that hardly vary in data, and their least scales."""

from __future__ import annotations

import pytest
import torch

from torchrl_gn.dynamics import BodyState, Controls, Couplings, Feature, ForwardModel, WorldContacts
from torchrl_gn.dynamics.bound import update_dynamic_normalizers
from torchrl_gn.dynamics.executors import eager
from torchrl_gn.dynamics.features import FEATURES
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.scenes import Scene, load_scene

from .. import zoo

BALL = """<mujoco><worldbody><geom type="plane" size="9 9 1"/>
  <body name="ball" pos="0 0 .1"><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""


def normalized(model: ForwardModel, scene: Scene, state: torch.Tensor) -> torch.Tensor:
    """The network's input of the nodes ``[B, N, F]``."""
    program, action = model.bind(scene).program(), state.new_zeros(len(state), scene.num_actions)
    nodes, _ = eager.features(program, eager.canonical_state(program, state, action), action)
    return model.node_normalizer(nodes)


def ball(height: float, count: int = 1) -> torch.Tensor:
    state = torch.as_tensor(load_scene(BALL).reference_state).repeat(count, 1, 1)
    state[:, 1, 2] = 0.1 + height
    return state


def test_a_contact_that_hardly_occurs_in_data_is_not_magnified():
    """Ant's trunk came within 10 cm of the floor once in 20,000 states; on the floor an input was 84,000."""
    scene, feature = load_scene(BALL), WorldContacts()
    high = ball(1.0, 20_000)
    high[0] = ball(0.0199)  # hardly near
    change = 0.02 * torch.randn(len(high), scene.num_nodes, 12, generator=torch.Generator().manual_seed(0)).double()
    after = BODY_STATE.apply(high, change * torch.as_tensor(scene.movable))
    largest = {}
    for least_scales in (True, False):
        features = BodyState(), Controls(), feature
        model = ForwardModel.for_scene(scene, features=features, least_scales=least_scales, hidden=8, latent=8)
        update_dynamic_normalizers(model.bind(scene), high, high.new_zeros(len(high), 0), after)
        start = model.node_normalizer.size - feature.size(BODY_STATE)
        largest[least_scales] = normalized(model, scene, ball(-0.01))[..., start:].abs().max().item()
    assert largest[True] < 30 < 1_000 < largest[False]


@pytest.mark.parametrize("name", ["creature", "tendon_arm", "constraints", "mirrored_gripper", "servos", "everything"])
def test_every_number_of_a_feature_has_a_least_scale(name):
    scene = zoo.load(name)
    for kind in FEATURES.values():
        feature: Feature = kind().resolved(scene) if kind.suits(scene) else kind()
        least = feature.least_scales(BODY_STATE)
        assert len(least) == feature.size(BODY_STATE) and min(least, default=0) >= 0


def test_a_description_of_before_means_those_of_constraints_alone():
    scene = zoo.load("mirrored_gripper")
    features = [feature.resolved(scene) for feature in (*ForwardModel.for_scene(scene, hidden=8).features, Couplings())]
    model = ForwardModel.for_scene(scene, features=features, hidden=8)
    description = model.description()
    assert ForwardModel.from_description(description).edge_normalizer.least == model.edge_normalizer.least
    del description["least_scales"]
    before = ForwardModel.from_description(description)
    couplings = tuple(features[-1].least_scales(BODY_STATE))
    assert not before.least_scales and before.edge_normalizer.least[-len(couplings) :] == couplings
    others = slice(-len(couplings))
    assert any(model.edge_normalizer.least[others]) and not any(before.edge_normalizer.least[others])
