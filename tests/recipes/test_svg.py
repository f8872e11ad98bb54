"""The recipe of stochastic value gradients: learning, resuming, and refusals."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from torchrl_gn.training import load_pretrained

from .conftest import SHORT_LEARNING

SMALL = (
    *SHORT_LEARNING,
    "agent.hidden=[8]",
    "agent.model_options={latent:4,hidden:[8],mlp_hidden:[8]}",
    "agent.policy_options={latent:4,hidden:[8]}",
)


@pytest.mark.slow
def test_a_run_is_learned_gone_on_with_and_kept_from_other_options(tmp_path, call):
    options = (*SMALL, "task.name=swimmer3", f"run_dir={tmp_path}", "logger=csv")
    code, _, errors = call(*options, "trainer.frames=80", recipe="svg")
    assert code == 0 and "warning" not in errors.lower(), errors
    first, curve = load_pretrained(tmp_path), json.loads((tmp_path / "curve.json").read_text())
    assert (curve["frames"], curve["updates"]) == ([0, 40, 80], [0, 0, 4])
    assert first.training["progress"]["updates"] == 4 and len(first.training["buffer"]["action"]) == 80

    code, output, errors = call(*options, "trainer.frames=120", recipe="svg")
    assert code == 0 and "warning" not in errors.lower(), errors
    again, metrics = load_pretrained(tmp_path), json.loads((tmp_path / "metrics.json").read_text())
    assert torch.equal(again.training["buffer"]["action"][:80], first.training["buffer"]["action"])
    assert again.training["curve"]["returns"][:3] == curve["returns"]
    assert (metrics["frames"], metrics["updates"]) == (120, 8)
    assert metrics["return"] == again.training["curve"]["returns"][-1] and 0 <= metrics["return"] <= 20
    printed = {Path(line).name for line in output.splitlines() if Path(line).is_file()}
    assert printed >= {"config.yaml", "curve.json", "curve.png", "metrics.json", "checkpoint.safetensors"}
    observation, action = torch.zeros(2, 13), torch.zeros(2, 2)
    model = again.agent.model
    assert model is not None and model.change_normalizer.count[0] == 120 * 3
    assert model.step(observation, action).isfinite().all()

    before = (tmp_path / "checkpoint" / "checkpoint.safetensors").read_bytes()
    code, _, errors = call(*options, "trainer.frames=120", "gamma=0.9", recipe="svg")
    assert code == 1 and "other options: gamma=0.9 (was 0.99)" in errors and "Traceback" not in errors
    assert (tmp_path / "checkpoint" / "checkpoint.safetensors").read_bytes() == before


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "has"),
    [
        (("horizon=0", "task.name=swimmer4", "agent.policy=graph"), (False, False)),
        (("horizon=2", "task=cheetah_run", "agent.model=mlp"), (True, True)),
    ],
    ids=["model-free graph policy", "cheetah"],
)
def test_other_agents_and_tasks_learn_too(tmp_path, call, options, has):
    code, _, errors = call(*SMALL, *options, "trainer.frames=80", f"run_dir={tmp_path}", recipe="svg")
    assert code == 0 and "warning" not in errors.lower(), errors
    agent = load_pretrained(tmp_path).agent
    assert (agent.model is not None, agent.reward is not None) == has
    assert json.loads((tmp_path / "metrics.json").read_text())["updates"] == 4


@pytest.mark.slow
def test_what_cannot_be_is_one_line(tmp_path, call):
    for number, (option, message) in enumerate(
        (
            ("task.name=crawler", "Only swimmers have a mapping built in"),
            ("task.timestep=0.003", "timestep=0.003 must be a positive multiple"),
            ("horizon=-1", "horizon=-1 must be a whole number, 0 or more"),
            ("agent.policy=tree", "policy='tree' is not known"),
            ("trainer.frames_per_batch=5", "frames_per_batch=5 must be a multiple of 2: num_envs times collectors"),
        )
    ):
        code, _, errors = call(*SMALL, option, f"run_dir={tmp_path / str(number)}", recipe="svg")
        assert code == 1 and message in errors and "Traceback" not in errors, errors
