"""Features of states that are seen from a target."""

from __future__ import annotations

import pytest
import torch

from torchrl_gn.data import Simulator, sample_start_states
from torchrl_gn.dynamics import Canonicalizer
from torchrl_gn.maths import quaternion
from torchrl_gn.policies import StateFeatures, StatePolicy, StateValue, task_invariances
from torchrl_gn.policies.body_frame_features import BodyFrameFeatures
from torchrl_gn.rewards.suite import Place
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
    own = StateFeatures(scene).size
    assert features.size == before.shape[-1] == own + 3 + 4 * len(features.nodes)
    higher = features(state, target=target + torch.tensor([0.0, 0.0, 0.5]))
    assert (higher - before)[:, : own + 2].abs().max() == 0  # its height is a feature of its own
    assert (higher - before)[:, own + 2].abs().min() > 0.1


def test_a_target_where_nothing_may_be_shifted_is_a_feature() -> None:
    scene = load_scene("pendulum")
    features, state = StateFeatures(scene, target=True), states_of(scene)
    target = torch.randn(6, 3, generator=torch.Generator().manual_seed(0)).double()
    features.fit(state, target)
    found, own = features(state, target=target), StateFeatures(scene).size
    given = torch.zeros(6, features.size, dtype=torch.float64)
    given[:, own : own + 3] = target
    torch.testing.assert_close(found[:, own : own + 3], features.normalizer(given)[:, own : own + 3])
    plain = StateFeatures(scene)
    plain.fit(state)
    torch.testing.assert_close(found[:, :own], plain(state))


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("suite:reacher/hard", lambda scene: Place.of_geom(scene, "finger")),  # welded to the hand
        ("suite:finger/turn_hard", lambda scene: Place.of_site(scene, "tip")),
        ("suite:fish/swim", lambda scene: Place.of_geom(scene, "mouth")),
    ],
)
def test_a_target_is_seen_from_the_place_that_is_paid(name: str, place) -> None:
    scene = load_scene(name)
    yaw = Canonicalizer(recenter=False, yaw=True)
    state, target = states_of(scene), torch.rand(6, 3, generator=torch.Generator().manual_seed(0)).double()
    away = place(scene)(state) - target
    for options in (None, yaw):
        features = StateFeatures(scene, options, target=True)
        features.fit(state, target)
        found = features.normalizer.inverse(features(state, target=target))[:, -4 * len(features.nodes) :]
        vectors, far = found[:, : -len(features.nodes)].unflatten(1, (-1, 3)), found[:, -len(features.nodes) :]
        if options is None or scene.yaw_frame is None:
            assert (vectors - away.unsqueeze(1)).abs().amax((0, 2)).min() < 1e-6
        wanted = (away.square().sum(-1, keepdim=True) / features.sized.square()).log1p()
        assert (far - wanted).abs().amax(0).min() < 1e-6


def test_moving_geoms_and_sites_alone_have_places() -> None:
    scene = load_scene("suite:reacher/hard")
    features, model = StateFeatures(scene, target=True), scene.model
    moving = [i for i in range(model.ngeom) if model.geom_bodyid[i] and model.geom(i).name != "target"]
    assert len(features.nodes) == len(moving) == 3


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


def test_a_task_may_have_fewer_rotations_than_its_scene() -> None:
    """A fish that swims has no direction, one that stays upright has the vertical."""
    scene = load_scene("suite:fish/swim")
    state = states_of(scene)
    state[..., 3:7] = quaternion.normalize(state[..., 3:7])
    rotations = quaternion.normalize(torch.randn(6, 4, generator=torch.Generator().manual_seed(0)).double())
    yaw = quaternion.normalize(rotations * torch.tensor([1.0, 0, 0, 1]))

    def turned(by: torch.Tensor) -> torch.Tensor:
        return torch.cat((state[:, :1], scene.layout.rotate(state, by)[:, 1:]), 1)

    def speed(state, action, next_state, task):
        return next_state[..., 1, 7:10].norm(dim=-1, keepdim=True)

    def upright(state, action, next_state, task):
        return quaternion.to_matrix(next_state[..., 1, 3:7])[..., -1:]

    free, level = task_invariances(scene, speed), task_invariances(scene, upright)
    assert free == Canonicalizer(recenter=True, yaw=True, full_rotation=True)
    assert level == Canonicalizer(recenter=True, yaw=True, full_rotation=False)
    for options, same, moved in ((free, rotations, None), (level, yaw, rotations)):
        for features in (StateFeatures(scene, options), BodyFrameFeatures(scene, options)):
            features.update(state)
            seen = [out if isinstance(out, torch.Tensor) else out.nodes for out in map(features, (state, turned(same)))]
            torch.testing.assert_close(*seen, rtol=0, atol=1e-6)
            if moved is not None:
                other = features(turned(moved))
                other = other if isinstance(other, torch.Tensor) else other.nodes
                assert (other - seen[0]).abs().max() > 0.1


def test_refuses_what_does_not_fit() -> None:
    scene = load_scene("swimmer3")
    state, features = states_of(scene), StateFeatures(scene, target=True)
    with pytest.raises(ValueError, match=r"need a target \[6, 3\], got None"):
        features(state)
    with pytest.raises(ValueError, match=r"need a target \[6, 3\], got \[3\]"):
        features(state, target=torch.zeros(3))
    with pytest.raises(ValueError, match="need recenter=False"):
        StateFeatures(scene, Canonicalizer(recenter=True, yaw=False), target=True)
