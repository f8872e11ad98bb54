"""The recipe that identifies numbers of a model."""

from __future__ import annotations

import json

import pytest


@pytest.mark.slow
def test_the_arm_is_found(call, tmp_path):
    code, output, errors = call("robots=1", "window=1000", f"run_dir={tmp_path / 'run'}", recipe="identify_parameters")
    assert code == 0, errors
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["largest relative error"] < 1e-6 and "arm: errors of 5 parameters of 1 robots" in output


@pytest.mark.slow
def test_any_system_is_found(call, tmp_path):
    options = ("system=pendulum", "parameters=[dof_damping, body_mass pole]", "trajectories=2", "steps=20")
    options += ("window=10", "robots=2", "noise=[0.001, 0.01]", "fit_starts=true")
    code, _, errors = call(*options, f"run_dir={tmp_path / 'run'}", recipe="identify_parameters")
    assert code == 0, errors
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["relative error"] < 0.5 and 0 <= metrics["within two"] <= 1


@pytest.mark.slow
def test_delays_are_found(call, tmp_path):
    options = ("system=pendulum", "parameters=[dof_damping, actuator_delay]", "trajectories=2", "steps=30")
    options += ("window=10", "robots=1", "actuator_delay=0.013", f"run_dir={tmp_path / 'run'}")
    code, output, errors = call(*options, recipe="identify_parameters")
    assert code == 0, errors
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["largest delay error"] < 1e-7 and metrics["largest relative error"] < 1e-6
    assert "delay: largest error (s)" in output


def test_a_delay_is_no_negative_number(call, tmp_path):
    code, _, errors = call("actuator_delay=-0.01", f"run_dir={tmp_path / 'run'}", recipe="identify_parameters")
    assert code and "actuator_delay=-0.01 must be seconds, at least 0" in errors
