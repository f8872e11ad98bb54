"""Every shipped model loads with one call and has the errors that it states."""

from __future__ import annotations

import warnings

import pytest

from torchrl_gn.evaluation import fresh_errors
from torchrl_gn.policies import Agent
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import CheckpointError, load_pretrained, pretrained_names, save_checkpoint
from torchrl_gn.training.checkpoint import WEIGHTS

QUICK = {"pendulum", "cartpole", "acrobot"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in pretrained_names()]
)
def test_a_shipped_model_has_the_errors_that_it_states(name):
    loaded = load_pretrained(name)
    trained, stated = loaded.trained, dict(loaded.metrics)
    assert not isinstance(trained, Agent)
    how = stated.pop("evaluation")
    scenes = {scene.name: scene for scene in loaded.scenes()}
    assert scenes.keys() <= stated.keys()
    # Of many lengths of swimmers, some that it was trained on and some that it was not: long ones take their time.
    for system in list(stated)[:: 5 if len(stated) > 5 else 1]:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # it is at home in its own scenes, and in others that it states errors of
            errors = fresh_errors(trained, scenes.get(system) or load_scene(system), **how)
        for key, value in stated[system].items():
            assert errors[key].total == pytest.approx(value, rel=0.05), (system, key)
            assert value < 1


def test_there_are_some_and_they_are_small():
    assert {
        "cartpole",
        "acrobot",
        "swimmer6",
        "cheetah",
        "walker2d",
        "jaco",
        "swimmerN",
        "five_systems",
        "identified_pendulum",
        "identified_cheetah",
    } <= set(pretrained_names())
    assert sum(path.stat().st_size for path in WEIGHTS.iterdir()) < 1e7


def test_a_wrong_name_names_the_right_ones():
    with pytest.raises(CheckpointError, match=r"no checkpoint at swimer6, .* 'cheetah'.* Did you mean 'swimmer6'\?"):
        load_pretrained("swimer6")


def test_a_model_is_found_by_its_name_or_where_it_lies(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shipped = load_pretrained("pendulum")
    save_checkpoint(tmp_path / "cartpole", shipped.model, scene=shipped.scene())
    assert load_pretrained("cartpole").scene().name == "cartpole"
    assert (
        load_pretrained("./cartpole").scene().name == load_pretrained(tmp_path / "cartpole").scene().name == "pendulum"
    )
    with pytest.raises(
        CheckpointError,
        match="no checkpoint at no_such_model, and the package has no trained model of that name.*'cheetah'",
    ):
        load_pretrained("no_such_model")
