"""Errors of poses in metres and radians."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.evaluation import pose_errors
from torchrl_gn.maths import quaternion
from torchrl_gn.scenes import load_scene


def test_a_body_that_stays_errs_by_the_way_it_goes():
    # Rotates by 0.1 rad and moves by (3, 4) cm a step: errors of staying are their means over steps 1 to 4.
    count = torch.arange(5, dtype=torch.float64)[None, :, None]
    state = torch.zeros(1, 5, 1, 13, dtype=torch.float64)
    state[..., 0, :3] = count * torch.tensor([0.03, 0.04, 0.0])
    state[..., 0, 3:7] = quaternion.exp(0.1 * count * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    flipped = state.clone()
    flipped[:, 1:, :, 3:7] *= -1  # the same rotation
    both = TensorDict({"state": torch.cat((state, flipped)), "action": torch.zeros(2, 4, 0)}, [2])
    errors = pose_errors(lambda now, action: now, both, node=0)
    assert errors.position.tolist() == pytest.approx([0.125] * 2) and errors.rotation.tolist() == pytest.approx(
        [0.25] * 2
    )
    numbers = errors.to_metrics()
    assert numbers["position_error"] == pytest.approx(0.125) and numbers["rotation_error/median"] == pytest.approx(0.25)


def test_what_diverges_errs_infinitely():
    state = torch.zeros(1, 3, 1, 13, dtype=torch.float64)
    state[..., 3] = 1
    data = TensorDict({"state": state, "action": torch.zeros(1, 2, 0)}, [1])
    errors = pose_errors(lambda now, action: now * math.nan, data, node=0)
    assert errors.position.item() == math.inf and errors.rotation.item() == math.inf


def test_a_model_is_measured_at_the_base_by_default():
    scene = load_scene("swimmer3")
    model = ForwardModel.for_scene(scene, hidden=8).bind(scene)
    state = model.reference_state.expand(2, 4, -1, -1).clone()
    state[1, :, 1, 0] += 1.0  # the second rollout starts elsewhere
    data = TensorDict({"state": state, "action": torch.zeros(2, 3, scene.num_actions, dtype=torch.float64)}, [2])
    predicted = model.rollout(state[:, 0], data["action"])[0]
    expected = (predicted - state)[:, 1:, 1, :3].norm(dim=-1).mean(1)
    torch.testing.assert_close(pose_errors(model, data).position, expected)
    with pytest.raises(ValueError, match="pass node="):
        pose_errors(lambda now, action: now, data)
