"""Options that may be lists, and bad ones that are refused before work begins."""

from __future__ import annotations

from pathlib import Path

import pytest

from _common.options import as_list, check_options, scene_options, unknown_options

omegaconf = pytest.importorskip("omegaconf")


def test_one_of_a_list_may_stand_alone():
    assert as_list("swimmer6") == ["swimmer6"] and as_list(0) == [0] and as_list(None) == []
    assert as_list(omegaconf.OmegaConf.create(["swimmer6", {"seed": 1}])) == ["swimmer6", {"seed": 1}]


RECIPES = Path(__file__).parents[2] / "recipes"


@pytest.mark.parametrize("file", sorted((RECIPES / "config").rglob("*.yaml")), ids=lambda file: file.stem)
def test_every_default_passes(file):
    check_options(omegaconf.OmegaConf.load(file))


@pytest.mark.parametrize(
    "word",
    ["optimizer=sgd", "lr=-1", "lr=abc", "gn.lr=.nan", "batch_size=0", "unroll_batch_size=1.5", "noise=-1", "lr=true"],
)
def test_bad_values_are_refused_by_name(word):
    name, value = word.split("=")
    options = omegaconf.OmegaConf.from_dotlist([word])
    with pytest.raises(ValueError, match=f"^{name}=(?i:{value.strip('.')}) must be "):
        check_options(options)


def test_lists_and_null_are_left_to_the_recipe():
    check_options({"lr": None, "batch_size": [1, 20], "data": {"train": 0}})


def test_mistyped_options_suggest_the_nearest():
    def hints(*words):
        return unknown_options(words, RECIPES / "forward_model.py")

    assert hints("minuts=3") == ["There is no option 'minuts'; did you mean 'minutes'?"]
    assert hints("hiden=64", "data.trian=5") == [
        "There is no option 'hiden'; did you mean 'model.hidden'?",
        "There is no option 'data.trian'; did you mean 'data.train'?",
    ]
    assert hints("qqqq=1") == ["There is no option 'qqqq'."]
    known = ["steps=3", "model={hidden: 3}", "model.features.contacts=false", "preset=paper", "+robot=hopper", "--x"]
    assert hints(*known, "hydra.verbose=true") == []


@pytest.mark.parametrize("recipe", ["forward_model", "mpc", "plan_and_learn"])
def test_options_of_a_scene(compose, recipe):
    assert scene_options(compose(recipe)) == {"timestep": None, "action_bounds": None, "wide_starts": 0.5}
    given = compose(recipe, "action_bounds={free: [-1, 2]}", "wide_starts=0", "timestep=0.02")
    assert scene_options(given) == {"timestep": 0.02, "action_bounds": {"free": [-1, 2]}, "wide_starts": 0}
