"""The systems that recipes/inference_model.py identifies, and the errors of its estimates."""

from __future__ import annotations

import pytest
import torch

from torchrl_gn.scenes import load_scene
from torchrl_gn.training import load_pretrained


@pytest.mark.parametrize("system", ["pendulum", "swimmer3"])
def test_systems_are_observed_from_one_start_with_and_without_control(system, load, compose):
    cfg = compose("inference_model", f"system={system}", "test.systems=4", "data.test=4")
    systems = load("inference_model").TestSystems(cfg, load_scene(system))
    state = systems.uncontrolled["state"]
    assert state.shape[:2] == (4, cfg.context_length + 1) and not systems.uncontrolled["action"].any()
    assert torch.equal(state[:, 0], systems.observed["state"][:, 0])
    speed = state[..., 7:].norm(dim=-1).amax()
    # Swimmers lie still, pendulums fall.
    assert (speed < 1e-6) == (system == "swimmer3")


@pytest.mark.slow
def test_another_systems_estimate_predicts_worse(load, compose):
    recipe, scene = load("inference_model"), load_scene("pendulum")
    cfg = compose("inference_model", "test.systems=8", "test.steps=[1]")
    model, systems = load_pretrained("identified_pendulum").trained, recipe.TestSystems(cfg, scene)
    tables, curve = recipe.identified_errors(cfg, model, scene, systems)
    errors = {way: table["rollout_error_20"].total for way, table in tables.items()}
    assert list(errors) == ["identified", "identified from another system", "identified without control"]
    # A pendulum that falls shows its length without control too.
    wrong = errors.pop("identified from another system")
    assert max(errors.values()) < 0.3 * wrong and list(curve) == [1]
