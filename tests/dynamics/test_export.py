"""Exported programs, run by a Python that has no torchrl_gn."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
import torch

from torchrl_gn.dynamics import export_step, specialize

ALONE = """
import sys
sys.modules["torchrl_gn"] = None  # importing it fails
import torch
path, given, found = sys.argv[1:]
step = torch.export.load(path).module()
given = torch.load(given)
torch.save([step(state, action) for state, action in given], found)
"""


@pytest.mark.slow
def test_a_program_predicts_as_its_model_for_any_batch_without_the_package(
    scenes, make_model, random_states, random_actions, tmp_path
):
    scene = scenes["pendulum"]
    bound = make_model(scene).bind(scene)
    path = export_step(bound, tmp_path / "step.pt2")
    given = [(random_states(scene, count), random_actions(scene, count).float()) for count in (1, 2, 7)]
    torch.save(given, tmp_path / "given.pt")
    arguments = [str(path), str(tmp_path / "given.pt"), str(tmp_path / "found.pt")]
    subprocess.run([sys.executable, "-c", ALONE, *arguments], check=True, cwd=tmp_path)
    changed = 0.0
    for (state, action), found in zip(given, torch.load(tmp_path / "found.pt"), strict=True):
        expected = specialize(bound).step(state, action)[0]
        changed = (expected - state).norm()
        assert (found - expected).norm() <= 1e-5 * changed
    assert changed > 0
    extra = {"scene.json": ""}
    torch.export.load(path, extra_files=extra)
    about = json.loads(extra["scene.json"])
    assert (about["scene"], about["nodes"], about["actions"]) == ("pendulum", list(scene.node_names), 1)


def test_a_model_of_many_variants_is_refused(scenes, make_model, tmp_path):
    scene = scenes["pendulum"]
    with pytest.raises(ValueError, match="physical parameters of their own"):
        export_step(make_model(scene).bind(scene, parameters_key="parameters"), tmp_path / "step.pt2")
    assert not list(tmp_path.iterdir())
