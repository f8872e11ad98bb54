"""The `model:` block of the recipes."""

from __future__ import annotations

import pytest
import torch

from _common.models import build_model, model_overrides
from torchrl_gn.dynamics import (
    Actuators,
    BodyState,
    Canonicalizer,
    Controls,
    ForwardModel,
    JointAxes,
    Joints,
    PairContacts,
    Wrenches,
)
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import load_pretrained, plain_config, save_checkpoint

from .conftest import ROOT


def test_the_block_says_what_the_model_is(compose):
    scene = load_scene("pendulum")
    options = ("model.features.contacts=false", "model.features.encoding=quaternion", "model.canonicalizer.yaw=false")
    model = build_model(scene, compose("forward_model", *options, "model.hidden=8", "model.parameters=none").model)
    assert model.features == (BodyState(encoding="quaternion"), Controls(per_joint=1), JointAxes(), Joints())
    assert model.canonicalizer == Canonicalizer(yaw=False) and model.parameter_source == "none"
    assert model.core_options == {"hidden": 8, "activation": "silu"} and model.core_name == "gn"
    assert build_model(scene, compose("forward_model").model, core="mlp", hidden=[4]).core_options["hidden"] == [4]


def test_rotors_are_features_without_an_option(compose):
    options = compose("forward_model").model
    quadrotor = load_scene(ROOT / "tests" / "zoo" / "quadrotor.xml", timestep=0.02)
    model = build_model(quadrotor, options)
    assert set(model.features) == set(ForwardModel.for_scene(quadrotor).features) and Wrenches() in model.features
    assert Wrenches() not in build_model([load_scene("pendulum")], options).features


@pytest.mark.parametrize(("option", "pusher", "cheetah"), [("null", 1, 0), ("true", 1, 1), ("false", 0, 0)])
def test_contact_edges_by_default_between_trees_alone(compose, option, pusher, cheetah):
    options = compose("forward_model", f"model.features.contact_pairs={option}").model
    for scene, wanted in (
        (load_scene(ROOT / "tests" / "zoo" / "pusher.xml"), pusher),
        (load_scene("cheetah"), cheetah),
    ):
        assert (PairContacts() in build_model(scene, options).features) == bool(wanted)


def test_the_papers_preset_shows_and_builds_in_what_the_paper_does(compose):
    model = build_model(load_scene("pendulum"), compose("forward_model", "preset=paper").model)
    assert model.features == (BodyState(encoding="quaternion"), Controls(per_joint=1))
    assert not (model.integrate or model.project or model.canonicalizer.yaw) and model.canonicalizer.recenter
    assert model.core_options == {"activation": "relu", "edge_hidden": [256, 256]}


@pytest.mark.parametrize("recipe", ["inference_model", "real_robot"])
def test_a_block_is_understood_by_another_recipe(compose, recipe):
    block = plain_config(compose(recipe, "model.features.positions=false", "model.layers=null").model)
    there = plain_config(compose("forward_model", *model_overrides(block)).model)
    assert there | block == there and not there["features"]["positions"]


def test_a_checkpoint_of_an_ablated_core_is_loaded(compose, tmp_path):
    scene = load_scene("pendulum")
    options = ("model.core=ablated", "+model.ablation=no_edge_update", "+model.skip=false", "model.hidden=8")
    model = build_model(scene, compose("forward_model", *options).model)
    save_checkpoint(tmp_path / "model.safetensors", model, scene=scene)
    again = load_pretrained(tmp_path / "model.safetensors").model
    assert again.core_name == "ablated" and again.description() == model.description()
    assert all(torch.equal(a, b) for a, b in zip(model.parameters(), again.parameters(), strict=True))


def test_servos_of_any_of_several_scenes_are_seen(compose):
    scenes = [load_scene("pendulum"), load_scene(ROOT / "tests" / "zoo" / "servo_arm.xml")]
    for model in (build_model(scenes, compose("forward_model").model), ForwardModel.for_scene(scenes)):
        assert Actuators() in model.features
    shown = build_model(scenes, compose("forward_model", "model.features.actuators=false").model).features
    assert Actuators() not in shown and Joints() in shown
