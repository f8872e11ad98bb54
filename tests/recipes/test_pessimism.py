"""The recipe that plans in an ensemble."""

from __future__ import annotations

import json

import pytest

SMALL = (
    "system=pendulum",
    "reward=balance",
    "members=2",
    "hidden=8",
    "train_steps=5",
    "data={trajectories: 20, length: 10}",
    "horizon=4",
    "steps=6",
    "episodes=2",
    "gn={iterations: 1, warm_up: 1, samples: 2}",
)


@pytest.mark.slow
def test_promises_are_compared_with_what_is_earned(call, tmp_path):
    run = tmp_path / "run"
    fall = "fall={body: pole, height: -10}"
    code, output, errors = call(*SMALL, "pessimism=[0, 1]", fall, f"run_dir={run}", recipe="pessimism")
    assert code == 0, errors
    metrics = json.loads((run / "metrics.json").read_text())
    for name in ("one model", "pessimism 0", "pessimism 1"):
        assert name in output and metrics[f"{name}/fallen"] == 0 and 0 <= metrics[f"{name}/kept"] <= 1
        assert (run / f"{name.replace(' ', '_')}.safetensors").is_file()
    assert metrics["one model/deviation"] == 0 < metrics["pessimism 0/deviation"]
    again = tmp_path / "again"
    code, _, errors = call(*SMALL, "pessimism=1", f"checkpoint={run}", f"run_dir={again}", recipe="pessimism")
    assert code == 0, errors
    found = json.loads((again / "metrics.json").read_text())
    assert found["pessimism 1/reward"] == metrics["pessimism 1/reward"]


def test_plans_must_fit_the_episodes(call, tmp_path):
    code, output, errors = call(*SMALL, "horizon=7", f"run_dir={tmp_path / 'run'}", recipe="pessimism")
    assert code == 1 and "steps=6 must be at least the horizon, 7" in output + errors
