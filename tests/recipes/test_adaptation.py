"""The recipe in which a motor fails."""

from __future__ import annotations

import json

import pytest

SMALL = ("system=swimmer6", "seconds=[0.1, 0.3]", "robots=2", "calibration=10", "test=10", "length=30")


@pytest.mark.slow
def test_a_dead_motor_is_found(call, tmp_path):
    run = tmp_path / "run"
    faults = "faults=[{command: 1, gain: 0.0}, {body: segment_0, mass: 2.0}]"
    code, output, errors = call(*SMALL, faults, f"run_dir={run}", recipe="adaptation")
    assert code == 0, errors
    metrics = json.loads((run / "metrics.json").read_text())
    name = "command 1, gain 0.0"
    assert metrics[f"{name}/0.3 s/one step"] < 0.1 * metrics[f"{name}/without/one step"]
    assert "body segment_0, mass 2.0" in output and (run / "gains.png").is_file()


@pytest.mark.slow
def test_a_load_is_learned_by_a_model_that_reads_masses(call, tmp_path):
    run, load = tmp_path / "run", "load={body: segment_4, masses: [0.5, 3]}"
    small = (*SMALL, load, "faults=[{body: segment_4, mass: 2.0}]", "train=20", "variants=4", "hidden=8")
    code, output, errors = call(*small, "minutes=0.02", f"run_dir={run}", recipe="adaptation")
    assert code == 0, errors
    assert "body segment_4, mass 2.0" in output and (run / "gains.png").is_file()
    again = (f"checkpoint={run}", f"run_dir={tmp_path / 'again'}")
    assert call(*small, *again, recipe="adaptation")[0] == 0  # which trains nothing
    first, second = (json.loads((tmp_path / name / "metrics.json").read_text()) for name in ("run", "again"))
    name = "body segment_4, mass 2.0/0.3 s/one step"
    assert first[name] == pytest.approx(second[name], rel=1e-4) and first[name] > 0
    assert not (tmp_path / "again" / "checkpoint").exists()
    code, output, errors = call(*SMALL, "load={body: hand, masses: [1, 2]}", recipe="adaptation")
    assert code == 1 and "the model has no 'hand'" in output + errors


def test_faults_are_named(call, tmp_path):
    code, output, errors = call(
        *SMALL, "faults=[{command: 5, gain: 0}]", f"run_dir={tmp_path / 'run'}", recipe="adaptation"
    )
    assert code == 1 and "A fault has a command below 5, or a body and its mass" in output + errors
