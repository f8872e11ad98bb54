"""Options that may be lists, and bad ones that are refused before work begins."""

from __future__ import annotations

import pytest

from _common.options import as_list, check_options, scene_options, unknown_options
from torchrl_gn.dynamics import Ensemble, ForwardModel
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import save_checkpoint

from ..copies import NAMES, RECIPES

omegaconf = pytest.importorskip("omegaconf")


def test_one_of_a_list_may_stand_alone():
    assert as_list("swimmer6") == ["swimmer6"] and as_list(0) == [0] and as_list(None) == []
    assert as_list(omegaconf.OmegaConf.create(["swimmer6", {"seed": 1}])) == ["swimmer6", {"seed": 1}]


@pytest.mark.parametrize("file", sorted(RECIPES.rglob("config/**/*.yaml")), ids=lambda file: file.stem)
def test_every_default_passes(file):
    check_options(omegaconf.OmegaConf.load(file))


@pytest.mark.parametrize(
    "word",
    [
        *(
            "optimizer=sgd",
            "lr=-1",
            "lr=abc",
            "gn.lr=.nan",
            "batch_size=0",
            "unroll_batch_size=1.5",
            "noise=-1",
            "lr=true",
        ),
        *(
            "steps=abc",
            "data.train=1.5",
            "model.hidden=0",
            "data.validation=0",
            "minutes=-1",
            "minutes=.inf",
            "seed=-1",
        ),
        *("logger=paper", "clock=sun", "data.pace=slow", "episodes=true", "timestep=0", "mpc.horizon=0.5"),
    ],
)
def test_bad_values_are_refused_by_name(word):
    name, value = word.split("=")
    options = omegaconf.OmegaConf.from_dotlist([word])
    with pytest.raises(ValueError, match=f"^{name}=(?i:{value.strip('.')}) must be "):
        check_options(options)


def test_lists_hold_what_one_may_be_and_null_is_left_to_the_recipe():
    check_options({"lr": None, "batch_size": [1, 20], "model": {"hidden": [[3, 4], 5]}, "share": {"test": 0.1}})
    for bad in ({"model": {"hidden": [3, 0]}}, {"horizons": [20, 1.5]}, {"batch_size": [1, "b"]}):
        with pytest.raises(ValueError, match="must be a whole number"):
            check_options(bad)


@pytest.mark.parametrize(
    ("word", "wanted"),
    [
        ("system=null", "given, such as swimmer6"),
        ("system=5", "a name"),
        ("device=true", "a name"),
        ("data.validation=null", "given, such as 200"),
        ("unroll_fraction=half", "a number"),
        ("model.project=1", "true or false"),
        ("model.features.contacts=null", "given, such as True"),
        ("data.length=[1,a]", "a number"),
    ],
)
def test_options_are_of_their_defaults_kind(compose, word, wanted):
    name, value = word.split("=")
    with pytest.raises(ValueError, match=rf"^{name}=.* must be {wanted}\.$"):
        check_options(compose("forward_model", word), RECIPES / "forward_model.py")


@pytest.mark.parametrize("recipe", NAMES)
def test_options_of_every_recipe_pass_as_they_are_and_null_where_the_comments_say_so(compose, recipe):
    check_options(compose(recipe), RECIPES / f"{recipe}.py")
    if recipe == "forward_model":
        words = (
            "steps=null",
            "minutes=0.5",
            "model.hidden=[8,8]",
            "system=[pendulum,cartpole]",
            "patience=3",
            "lr=1e-2",
        )
        check_options(compose(recipe, *words), RECIPES / f"{recipe}.py")
    if recipe == "real_robot":
        check_options(compose(recipe, "log=robot.csv", "lag=auto", "filter=auto"), RECIPES / f"{recipe}.py")


@pytest.mark.slow
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
    usual = {"timestep": None, "action_bounds": None, "wide_starts": 0.5, "mocap_actions": False, "motors": False}
    assert scene_options(compose(recipe)) == usual
    given = compose(recipe, "action_bounds={free: [-1, 2]}", "wide_starts=0", "timestep=0.02", "motors=true")
    chosen = {"timestep": 0.02, "action_bounds": {"free": [-1, 2]}, "wide_starts": 0, "motors": True}
    assert scene_options(given) == usual | chosen


@pytest.mark.parametrize(
    "recipe, options, idle",
    [
        ("ensemble", ("checkpoint=MODEL", "members=3", "data.train=7"), "members=3 (trained with 2), data.train=7"),
        (
            "pessimism",
            ("checkpoint=MODEL", "reward=balance", "members=3", "data.length=7"),
            "members=3 (trained with 2), data.length=7",
        ),
        ("adaptation", ("checkpoint=MODEL", "variants=3"), "variants=3"),
        ("adaptation", ("minutes=3",), "minutes=3 (trained with 10)"),
        ("forward_model", ("start_from=MODEL", "model.hidden=16"), "model.hidden=16"),
        ("benchmarks/work_precision", ("checkpoints=[MODEL]", "minutes=3"), "minutes=3"),
        ("stability", ("checkpoint=MODEL", "system=cartpole"), "system=cartpole"),
    ],
)
def test_options_of_a_training_that_does_not_take_place_are_refused(call, tmp_path, recipe, options, idle):
    scene, model = load_scene("pendulum"), tmp_path / "model.safetensors"
    made = Ensemble if recipe in ("ensemble", "pessimism") else ForwardModel
    count = {"count": 2} if made is Ensemble else {}
    save_checkpoint(model, made.for_scene(scene, hidden=4, **count), scene=scene, config={"members": 2})
    options = tuple(each.replace("MODEL", str(model)) for each in options)
    options = (*(() if recipe == "stability" else ("system=pendulum",)), *options, f"run_dir={tmp_path / 'run'}")
    code, _, errors = call(*options, recipe=recipe)
    assert code == 1 and f"{idle} would have no effect" in errors
    assert not (tmp_path / "run" / "metrics.json").exists()


def test_a_default_on_the_command_line_is_refused_like_any_other_value(run, tmp_path):
    scene, model = load_scene("pendulum"), tmp_path / "model.safetensors"
    save_checkpoint(model, Ensemble.for_scene(scene, hidden=4, count=2), scene=scene, config={"members": 2})
    options = "system=pendulum", f"checkpoint={model}", "members=5", f"run_dir={tmp_path / 'run'}"
    code, _, errors = run(*options, recipe="ensemble")
    assert code == 1 and "members=5 (trained with 2) would have no effect" in errors
