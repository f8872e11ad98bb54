"""Features of contact: distances and velocities of the points that can touch the plane."""

from __future__ import annotations

import pytest
import torch

from torchrl_gn.data import collect_trajectories
from torchrl_gn.dynamics import BodyState, Canonicalizer, Contacts, Controls, JointAxes
from torchrl_gn.dynamics.bound import dynamic_graph
from torchrl_gn.dynamics.features import CanonicalState, StepInputs
from torchrl_gn.maths import BODY_STATE, quaternion
from torchrl_gn.scenes import load_scene
from torchrl_gn.scenes.contact_points import SLOTS, contact_slots
from torchrl_gn.scenes.physical_parameters import PhysicalParameters

from .. import zoo


def features(scene, state):
    mask = torch.as_tensor(contact_slots(scene)[2])
    matrices = quaternion.to_matrix(state[..., 3:7]).unflatten(-1, (3, 3))
    bound = Contacts().bind(scene, BODY_STATE, Canonicalizer().bind(scene, BODY_STATE))
    inputs = StepInputs(CanonicalState(state, matrices, None), torch.empty(0), PhysicalParameters.of(scene))
    return bound(inputs).unflatten(-1, (SLOTS, 6)), mask


@pytest.mark.parametrize("name", ["cheetah", "walker2d"])
def test_points_are_where_the_physics_has_them(name):
    scene = load_scene(name)
    state = collect_trajectories(scene, 5, 100)["state"][:, -2:]
    seen, mask = features(scene, state)
    assert (seen[..., ~mask, :] == 0).all() and int(mask.sum()) == len(scene.contact_points.node)
    offset, radius, _ = (torch.as_tensor(value) for value in contact_slots(scene))
    frame = quaternion.to_matrix(state[..., 3:7]).unflatten(-1, (3, 3))
    place = state[..., None, :3] + torch.einsum("...nij,nkj->...nki", frame, offset)
    distance = (place[..., 2] - radius) * mask
    torch.testing.assert_close(seen[..., 0], distance)
    assert (distance[..., mask] > -0.05).all() and (distance[..., mask] < 0.01).any()  # stands on it
    torch.testing.assert_close(seen[..., 1], (distance / 0.02).clamp(-1, 1))
    # Velocities against differences along the bodies' own motion.
    still = torch.zeros_like(state[..., :6])
    later = BODY_STATE.apply(state, 1e-6 * torch.cat((state[..., 7:], still), dim=-1))
    frame = quaternion.to_matrix(later[..., 3:7]).unflatten(-1, (3, 3))
    moved = later[..., None, :3] + torch.einsum("...nij,nkj->...nki", frame, offset) - place
    torch.testing.assert_close(seen[..., 3:], 1e6 * moved * mask[..., None], rtol=0, atol=1e-4)
    soon = (seen[:, 0, ..., 0] + scene.timestep * seen[:, 0, ..., 5]) / 0.02
    torch.testing.assert_close(seen[:, 0, ..., 2], soon.clamp(-1, 1) * mask)


def test_a_tilted_plane_turns_with_the_world(random_states):
    scene = zoo.load("plane", ('size="9 9 1"', 'size="9 9 1" pos="1 0 .2" euler="0 20 0"'))
    state = random_states(scene, 4)
    seen, mask = features(scene, state)
    turn = quaternion.normalize(torch.tensor([1.0, 0.3, -0.5, 0.2], dtype=torch.float64)).expand(4, 4)
    turned, _ = features(scene, BODY_STATE.rotate(state, turn))
    torch.testing.assert_close(turned[..., :3], seen[..., :3])
    velocity = quaternion.rotate(turn[:, None, None], seen[..., 3:])
    torch.testing.assert_close(turned[..., 3:], velocity * mask[..., None])


def test_of_many_points_the_farthest_are_shown():
    scene = zoo.load("plane")
    assert len(scene.contact_points.node) == 9
    offset, _, mask = contact_slots(scene)
    assert mask[1].all() and (offset[1, :, 0] == 0.2).all()


@pytest.mark.parametrize("contacts", [True, False])
def test_a_model_sees_them_or_not(scenes, make_model, random_states, random_actions, contacts):
    scene = scenes["cheetah"]
    features = (BodyState(), Controls(), JointAxes(), *([Contacts()] if contacts else []))
    model = make_model(scene, features=features)
    assert model.dynamic_size.nodes == 18 + contacts * 24
    bound = model.bind(scene)
    state = random_states(scene, 3)
    assert dynamic_graph(bound, state, random_actions(scene, 3)).nodes.shape[-1] == model.dynamic_size.nodes
