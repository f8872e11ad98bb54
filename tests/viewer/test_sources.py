"""Names of scenes and models, and their results."""

from __future__ import annotations

import pytest

from torchrl_gn.dynamics import BoundEnsemble, Ensemble
from torchrl_gn.policies import StatePolicy, StateValue
from torchrl_gn.training import CheckpointError, save_checkpoint
from torchrl_gn.training.checkpoint import CHECKPOINT_FILE, POLICY_FILE
from torchrl_gn.viewer import load_policy, load_source

from .. import zoo


def test_systems_have_the_packages_own_model():
    scene, model = load_source("pendulum")
    assert model is not None and model.scene is scene and scene.name == "pendulum"


def test_swimmers_of_other_lengths_have_the_model_of_all_swimmers():
    scene, model = load_source("swimmer4")
    assert scene.num_nodes == 5 and model is not None


def test_a_file_has_no_model_and_its_actuators_get_bounds(tmp_path):
    file = tmp_path / "arm.xml"
    file.write_text(zoo.mjcf("two_links"))
    scene, model = load_source(str(file))
    assert model is None and scene.unbounded == ()


def test_run_folders_have_theirs(scenes, make_model, tmp_path):
    scene = scenes["pendulum"]
    save_checkpoint(tmp_path / CHECKPOINT_FILE, make_model(scene), scene=scene)
    found, model = load_source(str(tmp_path))
    assert found.fingerprint() == scene.fingerprint() and model is not None
    ensemble = Ensemble([make_model(scene, seed=seed) for seed in range(2)])
    save_checkpoint(tmp_path / "two.safetensors", ensemble, scene=scene)
    assert isinstance(load_source("pendulum", str(tmp_path / "two.safetensors"))[1], BoundEnsemble)


def test_what_does_not_predict_is_refused(scenes, tmp_path):
    path = tmp_path / "value.safetensors"
    save_checkpoint(path, StateValue(scenes["pendulum"]))
    with pytest.raises(ValueError, match="holds a StateValue, no forward model"):
        load_source("pendulum", str(path))
    with pytest.raises(CheckpointError, match="several scenes"):
        load_source("five_systems")
    with pytest.raises(ValueError, match="Did you mean 'pendulum'"):
        load_source("pendulm")
    with pytest.raises(CheckpointError, match="no checkpoint at nothing"):
        load_source("pendulum", "nothing")


def test_run_folders_have_policies(scenes, make_model, tmp_path):
    scene = scenes["pendulum"]
    assert load_policy("pendulum") is None and load_policy(str(tmp_path)) is None
    policy = StatePolicy(scene, hidden=[8])
    save_checkpoint(tmp_path / POLICY_FILE, policy, scene=scene)
    for found in (load_policy(str(tmp_path)), load_policy("pendulum", str(tmp_path / POLICY_FILE))):
        assert found is not None and found.description() == policy.description()
    save_checkpoint(tmp_path / "model.safetensors", make_model(scene), scene=scene)
    with pytest.raises(CheckpointError, match="ForwardModel, not BoundedPolicy"):
        load_policy("pendulum", str(tmp_path / "model.safetensors"))
    with pytest.raises(CheckpointError, match="no checkpoint at nothing"):
        load_policy("pendulum", "nothing")
