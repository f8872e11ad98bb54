"""Tables of a comparison."""

from __future__ import annotations

import json
import math

from omegaconf import OmegaConf


def test_what_diverged_spoils_no_table(load, tmp_path):
    recipe = load("compare")
    errors = {"default": (None, 2.0), "other": (1.0, 4.0), "diverged": (1.0, None)}  # of two systems
    cfg = {"variants": {name: {} for name in errors}, "systems": ["near", "far"], "only": None, "seeds": 0}
    cfg |= {"zero_shot": [], "minutes": 1, "steps": None, "clock": "wall", "threads": 1, "data_dir": "data"}
    trainings = recipe.all_trainings(OmegaConf.create({**cfg, "overrides": []}), tmp_path)
    for training in trainings:
        index = cfg["systems"].index(training.systems[0])
        training.run.folder.mkdir(parents=True)
        numbers = {key: errors[training.variant][index] for key in recipe.ERRORS} | {"steps": 10}
        (training.run.folder / "metrics.json").write_text(json.dumps(numbers))
    lines, metrics, _ = recipe.summarise(trainings, cfg["systems"])
    key = next(iter(recipe.ERRORS))
    # Against the finite reference alone.
    assert metrics[f"relative/default/{key}"] == 1.0 and math.isclose(metrics[f"relative/other/{key}"], 2.0)
    assert metrics[f"relative/diverged/{key}"] == math.inf and metrics[f"near/default/{key}"] == math.inf
    assert any(line.startswith("| diverged |") and line.endswith("| inf |") for line in lines)


def test_variants_may_stand_alone(load, tmp_path):
    recipe = load("compare")
    cfg = {"variants": {"default": {}, "other": {}}, "systems": "swimmer6", "only": "other", "seeds": [0], "steps": 5}
    cfg |= {
        "zero_shot": "swimmer7",
        "minutes": None,
        "clock": "wall",
        "threads": 1,
        "data_dir": "d",
        "overrides": "a=1",
    }
    (training,) = recipe.all_trainings(OmegaConf.create(cfg), tmp_path)
    assert training.systems == ("swimmer6",) and training.variant == "other"
    assert {"system=swimmer6", "zero_shot=[swimmer7]", "a=1"} <= set(training.run.overrides)


def test_the_reference_is_the_first_variant_alone(load, tmp_path):
    """No variant has a relative error on a system that the first variant lacks."""
    recipe = load("compare")
    variants = {"near alone": {"systems": ["near"]}, "both": {}, "again": {}}
    errors = {"near alone": [1.0], "both": [8.0, 5.0], "again": [2.0, 20.0]}
    cfg = {"variants": variants, "systems": ["near", "far"], "only": None, "seeds": 0, "zero_shot": [], "minutes": 1}
    cfg |= {"steps": None, "clock": "wall", "threads": 1, "data_dir": "data", "overrides": []}
    trainings = recipe.all_trainings(OmegaConf.create(cfg), tmp_path)
    for training in trainings:
        index = cfg["systems"].index(training.systems[0])
        training.run.folder.mkdir(parents=True)
        numbers = {key: errors[training.variant][index] for key in recipe.ERRORS} | {"steps": 10}
        (training.run.folder / "metrics.json").write_text(json.dumps(numbers))
    _, metrics, _ = recipe.summarise(trainings, cfg["systems"])
    key = next(iter(recipe.ERRORS))
    assert metrics[f"relative/near alone/{key}"] == 1
    assert math.isclose(metrics[f"relative/both/{key}"], 8) and math.isclose(metrics[f"relative/again/{key}"], 2)
