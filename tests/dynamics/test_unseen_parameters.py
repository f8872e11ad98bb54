"""Warnings name the properties of a scene that never varied in training."""

from __future__ import annotations

import warnings

import pytest
import torch

from torchrl_gn.dynamics import (
    UnseenParameterWarning,
    specialize,
)
from torchrl_gn.dynamics.bound import static_graph
from torchrl_gn.scenes import ParameterNames, load_scene
from torchrl_gn.scenes.systems import find_system


def thick_swimmer():
    """Swimmer6 in a medium of another viscosity."""
    spec = find_system("swimmer6").build()
    spec.option.viscosity = 0.5
    return load_scene(spec, timestep=0.02, name="thick")


def test_values_that_training_never_saw_are_named(scenes, make_model):
    scene = scenes["swimmer6"]
    model = make_model(scene)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnseenParameterWarning)
        model.bind(scene)
        model.bind(scene, strict=True)
        make_model(scene, fitted=False).bind(thick_swimmer())  # no training yet, nothing to compare
    with pytest.warns(UnseenParameterWarning, match="'thick' has values that the model never saw.*viscosity") as caught:
        model.bind(thick_swimmer())
    assert caught[0].filename == __file__
    assert "density" not in str(caught[0].message)
    with pytest.raises(ValueError, match="viscosity"):
        model.bind(thick_swimmer(), strict=True)
    with pytest.warns(UnseenParameterWarning, match=r"jnt_type\[FREE\].*density.*the same.*change of position z"):
        model.bind(scenes["falling"])


@pytest.mark.slow
def test_variants_with_values_that_training_never_saw_are_named(scenes, make_model, fit):
    model = make_model(scenes["swimmer6"])
    bound, strict = (
        model.bind(scenes["swimmer6"], strict=strict, parameters_key="parameters") for strict in (False, True)
    )
    for module in (bound, specialize(bound)):
        with pytest.warns(UnseenParameterWarning, match="'thick' has values .*viscosity") as caught:
            module.parameters_of(thick_swimmer())
        assert caught[0].filename == __file__
    for module in (strict, specialize(strict)):
        with pytest.raises(ValueError, match="viscosity"):
            module.parameters_of(thick_swimmer())
        module.parameters_of(scenes["swimmer6"])
    with pytest.warns(UnseenParameterWarning):
        fit(model, thick_swimmer())
    strict.parameters_of(thick_swimmer())


def test_a_feature_that_varied_in_training_is_not_unseen(scenes, make_model, fit):
    model = make_model(scenes["swimmer6"])
    with pytest.warns(UnseenParameterWarning):
        fit(model, thick_swimmer())
    model.bind(scenes["swimmer6"], strict=True)
    model.bind(thick_swimmer(), strict=True)


def test_a_model_without_parameters_reads_none(scenes, make_model, random_states, random_actions):
    scene = scenes["swimmer6"]
    model = make_model(scene, parameters="none")
    state, action = random_states(scene, 5), random_actions(scene, 5)
    assert model.parameter_names == ParameterNames()
    thick = model.bind(thick_swimmer(), strict=True)
    assert torch.equal(thick.step(state, action)[0], model.bind(scene).step(state, action)[0])
    informed = make_model(scene)
    read, nothing = (static_graph(each, each.scene_parameters) for each in (informed.bind(scene), model.bind(scene)))
    assert read.nodes.shape[-1] == len(informed.parameter_names.nodes) > 0
    assert nothing.nodes.shape[-1] == 0
