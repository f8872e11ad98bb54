"""Tests on a second device, without a GPU; every file runs in its own process, because the device changes torch."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from torchrl_gn.dynamics.executors.native.build import find_compiler

ROOT = Path(__file__).parents[1]
CASES = sorted(Path(__file__).with_name("fake_gpu").glob("cases_*.py"))


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="needs a C++ compiler, to build the device")
@pytest.mark.parametrize("cases", CASES, ids=lambda file: file.stem.removeprefix("cases_"))
def test_what_would_fail_on_a_gpu(cases):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))}
    command = [sys.executable, "-m", "pytest", "-q", "--tb=short", str(cases)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout[-10_000:] + done.stderr[-2_000:]
    assert "skipped" not in done.stdout
