"""Changes that a network predicts relative to the parent's."""

from __future__ import annotations

import pytest
import torch

from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.dynamics.bound import (
    moving_parents,
    relative_to_parents,
    residual,
    update_dynamic_normalizers,
)
from torchrl_gn.dynamics.executors import eager

from .. import zoo


def test_pairs_are_those_of_joints_whose_parent_moves(scenes):
    # The pole turns about the world, the swimmer's links about each other, the cheetah's legs about its torso, and a
    # tree with a free joint is left out.
    assert moving_parents(scenes["pendulum"]) == moving_parents(zoo.load("crawler")) == ()
    assert moving_parents(scenes["swimmer6"]) == ((2, 1), (3, 2), (4, 3), (5, 4), (6, 5))
    names = scenes["cheetah"].node_names
    assert [(names[node], names[above]) for node, above in moving_parents(scenes["cheetah"])] == [
        ("bthigh", "torso"),
        ("bshin", "bthigh"),
        ("bfoot", "bshin"),
        ("fthigh", "torso"),
        ("fshin", "fthigh"),
        ("ffoot", "fshin"),
    ]


@pytest.mark.parametrize("name", ["swimmer6", "gripper", "jaco"])
def test_relative_changes_add_up_to_the_changes(make_model, random_states, random_actions, name):
    scene = zoo.load(name)
    model = make_model(scene).double()
    state, action = random_states(scene, 3), random_actions(scene, 3)
    program = model.bind(scene).program()
    assert program.parents
    change = residual(program, state, action, random_states(scene, 3, seed=1))
    relative = relative_to_parents(program, change)
    root, child = program.parents[0][1], program.parents[0][0]
    torch.testing.assert_close(relative[:, child], change[:, child] - change[:, root])
    together = torch.cat((torch.zeros_like(change), relative), dim=-1)
    torch.testing.assert_close(eager.summed(program, together), change)
    torch.testing.assert_close(eager.summed(program, torch.cat((change, 0 * relative), dim=-1)), change)


def test_relative_outputs_have_the_scale_of_relative_changes(scenes, make_model):
    """Links that move together change alike, and little against each other."""
    scene = scenes["swimmer6"]
    model = ForwardModel.for_scene(scene, hidden=8, latent=8)
    reference = torch.as_tensor(scene.reference_state).expand(50, -1, -1)
    after = reference.clone()
    moves = torch.as_tensor(scene.predicted).double().unsqueeze(-1)
    pushed = torch.linspace(-1, 1, 50, dtype=torch.float64).view(-1, 1, 1)
    after[..., 7:8] += pushed * moves  # one velocity for all links
    after[..., 6:7, 7:8] += 0.01 * pushed  # but for the last one's, which is a little faster
    update_dynamic_normalizers(
        model.bind(scene), reference, torch.zeros(50, scene.num_actions, dtype=torch.float64), after
    )
    assert model.relative_normalizer is not None
    whole, relative = (each.std[6].item() for each in (model.residual_normalizer, model.relative_normalizer))
    # Of six links the root alone moves against no parent: its change is all of its relative one.
    assert relative == pytest.approx(whole * (1 + 1e-4) ** 0.5 / 6**0.5, rel=0.01)


def test_what_has_no_parent_that_moves_has_no_such_outputs(scenes):
    assert not ForwardModel.for_scene(scenes["pendulum"], hidden=8).parent_relative
    assert not ForwardModel.for_scene(scenes["falling"], hidden=8).parent_relative
    model = ForwardModel.for_scene([scenes["pendulum"], scenes["swimmer6"]], hidden=8)
    assert model.parent_relative and model.bind(scenes["pendulum"]).program().parents == ()


def test_a_description_of_before_means_none(scenes):
    model = ForwardModel.for_scene(scenes["swimmer6"], hidden=8)
    description = model.description()
    assert ForwardModel.from_description(description).parent_relative
    del description["parent_relative"]
    before = ForwardModel.from_description(description)
    assert not before.parent_relative and "relative_normalizer.mean" not in before.state_dict()
