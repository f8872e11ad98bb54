"""The recipe that trains, calibrates and tests an ensemble."""

from __future__ import annotations

import json

import pytest

SMALL = (
    "system=pendulum",
    "members=2",
    "steps=5",
    "hidden=8",
    "data={train: 20, calibration: 20, test: 10, other: 10}",
)


@pytest.mark.slow
def test_coverage_is_measured_and_the_ensemble_kept(call, tmp_path):
    run = tmp_path / "run"
    code, output, errors = call(*SMALL, "data.length=12", "horizons=[1,12]", f"run_dir={run}", recipe="ensemble")
    assert code == 0, errors
    assert output.count("within 1 / 2 std") == 2 and "control that changes 3 times as slowly" in output
    metrics = json.loads((run / "metrics.json").read_text())
    assert 0 < metrics["training_seconds"] < metrics["wall_clock_seconds"]  # of the members' trainings, as elsewhere
    assert metrics["steps"] == 10 and all(
        0 <= metrics[f"{split}/one_12/orientation"] <= 1 for split in ("test", "other")
    )
    assert (run / "prediction.png").is_file() and (run / "checkpoint" / "checkpoint.safetensors").is_file()
    again = tmp_path / "again"
    options = ("data.length=12", "horizons=[1,12]", f"run_dir={again}", f"checkpoint={run}")
    assert call(*SMALL, *options, recipe="ensemble")[0] == 0  # which trains nothing
    other = json.loads((again / "metrics.json").read_text())
    assert other["steps"] == 0 and all(other[name] == value for name, value in metrics.items() if "/" in name)
    options = (f"checkpoint={run}", "sequences=10", f"run_dir={tmp_path / 'evaluated'}")
    code, output, errors = call(*options, recipe="evaluate")
    assert code == 0 and "within 1 / 2 std" in output and "Joints, over 100 steps" in output, errors
    evaluated = json.loads((tmp_path / "evaluated" / "metrics.json").read_text())
    assert evaluated["coverage/one_20/orientation"] >= 0 and evaluated["rollout_error_20"] > 0


def test_horizons_fit_the_trajectories(call, tmp_path):
    code, output, errors = call(*SMALL, "data.length=50", f"run_dir={tmp_path / 'run'}", recipe="ensemble")
    assert code == 1 and "horizons=[1, 10, 50, 100] must be up to data.length=50" in output + errors
    assert not (tmp_path / "run").exists()
