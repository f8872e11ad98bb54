"""The recipe that plans in an ensemble."""

from __future__ import annotations

import json
import math
import statistics

import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict

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


def test_steps_of_unstable_simulations_count_nowhere(load):
    """One of three episodes becomes unstable at its third step, another at its first."""
    recipe, cfg = load("pessimism"), OmegaConf.create({"horizon": 2, "episodes": 3, "fall": None})
    reward = torch.tensor([[1.0, 2.0, 3.0, 4.0], [5.0, 7.0, math.nan, math.nan], [math.nan] * 4])
    promised = torch.tensor([[2.0, 2.0, 4.0, 99.0], [6.5, 99.0, 99.0, 99.0], [99.0] * 4])
    episodes = TensorDict({"reward": reward, "promised": promised, "deviation": torch.ones(3, 4)}, [3, 4])
    found = recipe.summarize(cfg, None, episodes)
    assert found["unstable"] == 2 and found["reward"] == pytest.approx(22 / 6)
    assert found["reward_std"] == pytest.approx(statistics.stdev([2.5, 6]))
    assert found["earned"] == pytest.approx((1.5 + 2.5 + 3.5 + 6) / 4) and found["promised"] == pytest.approx(14.5 / 4)
    assert found["kept"] == 1 and found["deviation"] == 1
