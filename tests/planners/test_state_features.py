"""Features of states that are seen from a target."""

from __future__ import annotations

import pytest
import torch

from torchrl_gn.data import Simulator, sample_start_states
from torchrl_gn.dynamics import Canonicalizer
from torchrl_gn.planners import StateFeatures, StatePolicy, StateValue
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import load_pretrained, save_checkpoint


def states_of(scene) -> torch.Tensor:
    return Simulator(scene).observe(torch.from_numpy(sample_start_states(scene, 6, 0)))


def test_where_bodies_are_from_the_target_counts() -> None:
    scene = load_scene("swimmer3")
    features, state = StateFeatures(scene, target=True), states_of(scene)
    generator = torch.Generator().manual_seed(0)
    target = torch.randn(6, 3, generator=generator).double()
    features.fit(state + 0, target)
    before = features(state, target=target)
    both = torch.tensor([0.7, -0.4, 0.0], dtype=torch.float64)  # the scene slides along x and y
    moved = state.clone()
    moved[:, 1:, :3] += both
    torch.testing.assert_close(features(moved, target=target + both), before)
    assert (features(moved, target=target) - before).abs().max() > 0.1
    assert (features(state, target=target + both) - before).abs().max() > 0.1
    assert features.size == before.shape[-1] == StateFeatures(scene).size + 3
    higher = target + torch.tensor([0.0, 0.0, 0.5])
    assert (features(state, target=higher) - before)[:, :-1].abs().max() == 0  # its height is a feature of its own


def test_a_target_where_nothing_may_be_shifted_is_a_feature() -> None:
    scene = load_scene("pendulum")
    features, state = StateFeatures(scene, target=True), states_of(scene)
    target = torch.randn(6, 3, generator=torch.Generator().manual_seed(0)).double()
    features.fit(state, target)
    found = features(state, target=target)
    torch.testing.assert_close(found[:, -3:], features.normalizer(torch.cat((0 * found[:, :-3], target), 1))[:, -3:])
    plain = StateFeatures(scene)
    plain.fit(state)
    torch.testing.assert_close(found[:, :-3], plain(state))


def test_networks_keep_their_target_in_files(tmp_path) -> None:
    scene = load_scene("swimmer3")
    state, target = states_of(scene), torch.rand(6, 3).double()
    for network in (StatePolicy(scene, hidden=[8], target=True), StateValue(scene, hidden=[8], target=True)):
        network.features.fit(state, target)
        save_checkpoint(tmp_path / "it.safetensors", network, scene=scene)
        again = load_pretrained(tmp_path / "it.safetensors").trained
        if isinstance(network, StatePolicy):
            assert isinstance(again, StatePolicy) and again.in_keys == ["state", "target"]
            assert torch.equal(again.act(state, target), network.act(state, target))
        else:
            assert isinstance(again, StateValue)
            assert torch.equal(again(state, target), network(state, target))


def test_refuses_what_does_not_fit() -> None:
    scene = load_scene("swimmer3")
    state, features = states_of(scene), StateFeatures(scene, target=True)
    with pytest.raises(ValueError, match=r"need a target \[6, 3\], got None"):
        features(state)
    with pytest.raises(ValueError, match=r"need a target \[6, 3\], got \[3\]"):
        features(state, target=torch.zeros(3))
    with pytest.raises(ValueError, match="need recenter=False"):
        StateFeatures(scene, Canonicalizer(recenter=True, yaw=False), target=True)
