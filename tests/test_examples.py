"""Every script of the gallery runs without a warning, draws its picture, and stands on the page."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "docs" / "examples").glob("*.py"))
PICTURES = ROOT / "docs" / "images" / "examples"
SHORTENED = {
    "cem": ("rollout(100,", "rollout(10,"),
    "new_scene": ("steps=400", "steps=10"),
    "policy": ("range(100)", "range(2)"),
    "robot_log": ("steps=500", "steps=10"),
    "train": ("steps=300", "steps=10"),
}
"""Parts of long examples, and the test's shorter replacements."""


@pytest.mark.slow
@pytest.mark.parametrize("script", EXAMPLES, ids=lambda script: script.stem)
def test_example_draws_its_picture(script, tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    text = script.read_text()
    if script.stem in SHORTENED:
        assert text.count(SHORTENED[script.stem][0]) == 1
        text = text.replace(*SHORTENED[script.stem])
    (tmp_path / script.name).write_text(text)
    done = subprocess.run(
        [sys.executable, script.name], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert "warning" not in (done.stdout + done.stderr).lower()
    with Image.open(tmp_path / f"{script.stem}.png") as picture:
        assert min(picture.size) >= 100


@pytest.mark.parametrize("script", EXAMPLES, ids=lambda script: script.stem)
def test_example_is_short_and_on_the_page(script):
    assert len(script.read_text().splitlines()) < 40
    page = (script.parent / "README.md").read_text()
    assert f"(../images/examples/{script.stem}.png)" in page and f"\n[`{script.name}`]({script.name})\n" in page
    assert (PICTURES / f"{script.stem}.png").stat().st_size < 60_000
