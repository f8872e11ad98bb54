"""Pieces of the suite's episodes, on which models are evaluated."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_gn.scenes import load_scene

suite = pytest.importorskip("dm_control.suite")


@pytest.fixture
def recipe(load, monkeypatch):
    """With episodes of 40 steps."""
    monkeypatch.setattr(load("evaluate"), "EPISODE", 40)
    return load("evaluate")


def test_pieces_are_what_the_suite_plays(recipe):
    scene = load_scene("cheetah")
    pieces = recipe.pieces_of_episodes(scene, "cheetah/run", 7, 40, seed=3)  # as long as the episodes
    assert pieces["state"].shape == (7, 41, scene.num_nodes, 13) and pieces["action"].shape == (7, 40, 6)
    torch.testing.assert_close(pieces["state"][0], pieces["state"][4], rtol=0, atol=0)  # of the same episode
    assert not pieces["state"][0].equal(pieces["state"][5])
    env = suite.load("cheetah", "run", task_kwargs={"random": 3})
    env.reset()
    for step, action in enumerate(pieces["action"][0]):
        poses = env.physics.data.xpos[scene.body[1:]]
        np.testing.assert_allclose(pieces["state"][0, step, 1:, :3], poses, atol=1e-6, err_msg=str(step))
        env.step(action.numpy())
    assert pieces["action"].abs().max() <= 1 and pieces["action"].std() == pytest.approx(3**-0.5, rel=0.1)


def test_pieces_lie_anywhere_in_an_episode(recipe):
    pieces = recipe.pieces_of_episodes(load_scene("pendulum"), "pendulum/swingup", 20, 10, seed=0)
    assert pieces["state"].shape[:2] == (20, 11)
    assert len(pieces["state"][:5, 0].unique(dim=0)) > 1


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("cheetah", "must be a domain and a task, as in cheetah/run"),
        ("cheetah/fly", "no task cheetah fly; there are run"),
        ("walker/run", r"has joints .* 'cheetah' has"),
    ],
)
def test_tasks_that_do_not_fit_are_refused(recipe, name, message):
    with pytest.raises(ValueError, match=message):
        recipe.pieces_of_episodes(load_scene("cheetah"), name, 5, 10, seed=0)


def test_a_control_step_needs_its_system(call, tmp_path):
    code, output, errors = call(
        "checkpoint=pendulum", "timestep=0.05", f"run_dir={tmp_path / 'run'}", recipe="evaluate"
    )
    assert code == 1 and "timestep=0.05 is for another system" in output + errors and not (tmp_path / "run").exists()


def test_one_model_is_evaluated(call, tmp_path):
    code, output, errors = call("checkpoint=[pendulum,cartpole]", f"run_dir={tmp_path / 'run'}", recipe="evaluate")
    assert code == 1 and "must be one model: run the recipe for each" in output + errors
    assert "Traceback" not in errors and not (tmp_path / "run").exists()
