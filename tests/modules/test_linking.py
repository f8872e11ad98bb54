"""Bodies that joints pin together stay together, and are predicted better for it."""

from __future__ import annotations

import pytest
import torch

from torchrl_gn.data import collect_trajectories
from torchrl_gn.modules import BODY_STATE, quaternion
from torchrl_gn.scenes import load_scene

LINKED = ["pendulum", "cartpole", "acrobot", "swimmer6", "cheetah", "walker2d", "jaco"]


def link(bound, state, delta):
    return bound.linking(state, delta, bound.model.delta_normalizer.std, bound.values.parent_arm, bound.values.arm)


def gaps(scene, state):
    """How far, and how fast, every joint's pin is apart on its two bodies."""
    linkage = scene.linkage
    frame = quaternion.to_matrix(state[..., 3:7]).unflatten(-1, (3, 3))
    places, speeds = [], []
    for node, arms in ((linkage.parent, linkage.parent_arm), (range(scene.num_nodes), linkage.arm)):
        node = torch.as_tensor(list(node))
        arm = (frame[..., node, :, :] @ torch.as_tensor(arms).unsqueeze(-1)).squeeze(-1)
        places.append(state[..., node, :3] + arm)
        speeds.append(state[..., node, 7:10] + torch.linalg.cross(state[..., node, 10:], arm))
    return (places[1] - places[0]).abs().max(), (speeds[1] - speeds[0]).abs().max()


@pytest.mark.parametrize("name", LINKED)
def test_true_changes_are_linked_already(make_model, name):
    scene = load_scene(name)
    trajectories = collect_trajectories(scene, 2, 20)
    state, after = trajectories["state"][:, :-1], trajectories["state"][:, 1:]
    assert max(gaps(scene, state)) < 1e-12
    bound = make_model(scene, fitted=False).bind(scene)
    delta = BODY_STATE.delta(state, after)
    torch.testing.assert_close(link(bound, state, delta), delta, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", LINKED)
def test_pinned_bodies_stay_together(make_model, random_actions, name):
    scene = load_scene(name)
    trajectories = collect_trajectories(scene, 2, 20)
    state = trajectories["state"][:, -1].clone()
    moving = torch.as_tensor(scene.live[:, :3]).double()
    state[..., :3] += 0.01 * moving  # where the network's errors may have led
    bound, loose = (make_model(scene, link=link).bind(scene) for link in (True, False))
    actions = random_actions(scene, 2, 20)
    assert max(gaps(scene, bound.rollout(state, actions)[:, 1:].detach())) < 1e-10
    if name != "pendulum":
        assert max(gaps(scene, loose.rollout(state, actions)[:, 1:].detach())) > 1e-4


def test_a_linkage_moves_as_its_bodies_mean(scenes, make_model, random_actions):
    """What the bodies disagree on is averaged; what they agree on is kept."""
    scene = scenes["swimmer6"]
    bound = make_model(scene, fitted=False).bind(scene)
    state = collect_trajectories(scene, 2, 3)["state"][:, -1]
    generator = torch.Generator().manual_seed(0)
    change = 0.01 * torch.randn(2, 7, 12, generator=generator, dtype=torch.float64) * bound.live
    change[..., 3:6] = change[..., 9:] = 0
    linked = link(bound, state, change)
    shared = change[:, 1:, [0, 1, 6, 7]].mean(1, keepdim=True).expand(-1, 6, -1)
    torch.testing.assert_close(linked[:, 1:, [0, 1, 6, 7]], shared, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", LINKED)
def test_levers_are_the_derivative_of_places(make_model, name):
    """How turning moves the bodies of a linkage, against differences."""
    scene = load_scene(name)
    bound = make_model(scene).bind(scene)
    state = collect_trajectories(scene, 2, 5)["state"][:, -1]
    generator = torch.Generator().manual_seed(0)
    live = torch.as_tensor(scene.live)
    turn = torch.randn(2, scene.num_nodes, 3, generator=generator, dtype=torch.float64) * live[:, 9:]
    still = torch.zeros_like(turn)

    arms = bound.linking.arms(state, bound.values.parent_arm, bound.values.arm)

    def apart(turn):
        places = bound.linking.pins(state, arms, turn, still)[1][..., :3]
        return places - torch.where(bound.linking.root_moves, bound.linking.mean @ places, still)

    moves = (arms.flatten(1) @ bound.linking.levers).unflatten(-1, (-1, len(bound.linking.turning)))
    moved = (moves @ turn.flatten(1)[:, bound.linking.turning].unsqueeze(-1)).view_as(turn)
    torch.testing.assert_close((apart(1e-6 * turn) - apart(-1e-6 * turn)) / 2e-6, moved, rtol=1e-6, atol=1e-8)


def test_what_bodies_disagree_on_is_settled_by_least_squares(make_model):
    """No other linked change is nearer to the network's, in units of each component's spread."""
    scene = load_scene("swimmer6")
    bound = make_model(scene).bind(scene)
    state = collect_trajectories(scene, 2, 5)["state"][:, -1]
    generator = torch.Generator().manual_seed(0)
    raw = 1e-5 * torch.randn(2, 7, 12, generator=generator, dtype=torch.float64) * bound.live
    linked = link(bound, state, raw)
    std = bound.model.delta_normalizer.std
    v, w = std[6:9].norm(), std[9:].norm()

    def distance(delta):
        return ((delta - raw)[..., 6:9] / v).square().sum() + ((delta - raw)[..., 9:] / w).square().sum()

    nearest = distance(linked)
    assert nearest < distance(torch.zeros_like(raw))
    for seed in range(5):
        other = torch.randn(2, 7, 12, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * bound.live
        assert distance(link(bound, state, linked + 1e-6 * other)) > nearest * (1 - 1e-6)
