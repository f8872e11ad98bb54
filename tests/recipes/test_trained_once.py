"""Recipes that train a model before they measure it: the same run folder keeps it; others do not replace it."""

from __future__ import annotations

import json

import pytest
import torch

from torchrl_gn.scenes import load_scene
from torchrl_gn.training import load_pretrained, save_checkpoint
from torchrl_gn.training.tensor_files import load_tensors

from . import test_adaptation, test_ensemble, test_pessimism

MODEL = "checkpoint/checkpoint.safetensors"
LOAD = "load={body: segment_4, masses: [0.5, 3]}"
CASES = {
    "ensemble": (
        (*test_ensemble.SMALL, "data.length=12", "horizons=[1,12]"),
        ("horizons=[1]", "data.test=12"),
        "data.train=21",
    ),
    "pessimism": ((*test_pessimism.SMALL, "pessimism=[1]"), ("pessimism=[2]", "steps=5"), "train_steps=6"),
    "adaptation": (
        (*test_adaptation.SMALL, LOAD, "faults=[{body: segment_4, mass: 2.0}]", "minutes=0.02", "train=20")
        + ("variants=4", "hidden=8"),
        ("faults=[{command: 0, gain: 0.5}]", "robots=3"),
        "minutes=0.03",
    ),
}


def weights(run) -> dict[str, torch.Tensor]:
    return {name: value for name, value in load_tensors(run / MODEL).items() if name.startswith("model.members")} or {
        name: value for name, value in load_tensors(run / MODEL).items() if name.startswith("model.")
    }


@pytest.mark.slow
@pytest.mark.parametrize("recipe", CASES)
def test_a_trained_model_is_measured_again_and_not_replaced(recipe, call, tmp_path):
    options, measured, trained = CASES[recipe]
    run = tmp_path / "run"
    code, _, errors = call(*options, f"run_dir={run}", recipe=recipe)
    assert code == 0, errors
    first, whole = json.loads((run / "metrics.json").read_text()), weights(run)
    (run / "metrics.json").unlink()  # as if it was killed while it measured
    code, output, errors = call(*options, f"run_dir={run}", recipe=recipe)
    assert code == 0 and "was trained before and is measured again" in output + errors, errors
    again = json.loads((run / "metrics.json").read_text())
    times = ("milliseconds", "wall_clock_seconds", "sha256")
    assert {name: value for name, value in again.items() if not name.endswith(times)} == {
        name: value for name, value in first.items() if not name.endswith(times)
    }
    code, _, errors = call(*options, *measured, f"run_dir={run}", recipe=recipe)
    assert code == 0, errors
    code, output, errors = call(*options, trained, f"run_dir={run}", recipe=recipe)
    assert code == 1 and f"holds a run with other options: {trained} (was" in output + errors
    assert weights(run).keys() == whole.keys()
    assert all(torch.equal(value, whole[name]) for name, value in weights(run).items())


def test_a_checkpoint_is_not_published_over_itself(call, tmp_path, make_model):
    scene = load_scene("pendulum")
    file = tmp_path / "run" / MODEL
    save_checkpoint(file, make_model(scene), scene=scene, training={"step": 3})
    linked = tmp_path / "linked.safetensors"
    linked.symlink_to(file)
    for target in (file, linked, tmp_path / "run"):
        code, output, errors = call(f"checkpoint={tmp_path / 'run'}", f"file={target}", recipe="publish")
        assert code == 1 and "whose training would be lost" in output + errors
    assert load_pretrained(file).training == {"step": 3}


def test_weights_beyond_half_precision_are_not_published(call, tmp_path, make_model):
    scene = load_scene("pendulum")
    model = make_model(scene)
    with torch.no_grad():
        next(model.core.parameters()).view(-1)[0] = 1e6
    save_checkpoint(tmp_path / "run" / MODEL, model, scene=scene)
    file = tmp_path / "small.safetensors"
    code, output, errors = call(f"checkpoint={tmp_path / 'run'}", f"file={file}", recipe="publish")
    assert code == 1 and "has weights beyond half precision, 65504: core" in output + errors and not file.exists()
