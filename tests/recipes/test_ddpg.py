"""The model-free baseline's recipe."""

from __future__ import annotations

import json

import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.training import load_pretrained

from .conftest import SHORT_LEARNING

SMALL = (
    "task.name=swimmer3",
    *SHORT_LEARNING,
    "hidden=[8]",
)


@pytest.mark.slow
def test_a_run_is_learned_gone_on_with_and_kept_from_other_options(tmp_path, call):
    for frames, updates in ((80, 4), (120, 8)):
        code, _, errors = call(*SMALL, f"trainer.frames={frames}", f"run_dir={tmp_path}", recipe="ddpg")
        assert code == 0 and "warning" not in errors.lower(), errors
        metrics = json.loads((tmp_path / "metrics.json").read_text())
        assert (metrics["frames"], metrics["updates"]) == (frames, updates)
    saved = load_pretrained(tmp_path)
    assert saved.agent.model is None and len(saved.training["buffer"]["action"]) == 120
    explored = saved.training["buffer"]["action"][40:]
    assert explored.abs().max() <= 1 and explored.std() > 0.1
    chosen = saved.agent.policy(TensorDict({"observation": torch.randn(5, 13)}, [5]))["action"]
    assert (chosen.abs() < 1).all()
    code, _, errors = call(*SMALL, "trainer.frames=120", "noise=0.3", f"run_dir={tmp_path}", recipe="ddpg")
    assert code == 1 and "other options: noise=0.3 (was 0.2)" in errors and "Traceback" not in errors
