"""Checkpoints: exact round trips, and errors that name the file for every damage."""

from __future__ import annotations

import copy
import json
import math
import struct

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from tensordict import TensorDict
from torch import nn
from torch.nn.utils import parametrizations, prune

from torchrl_gn.dynamics import Ensemble, ForwardModel, specialize
from torchrl_gn.policies import Agent, StatePolicy
from torchrl_gn.scenes import KinematicTree, ObservationGraph, load_scene
from torchrl_gn.training import Budget, CheckpointError, load_pretrained, package_versions, save_checkpoint
from torchrl_gn.training import checkpoint as module
from torchrl_gn.training.tensor_files import digest_of


@pytest.fixture
def trained(make_trainer):
    trainer = make_trainer(Budget(steps=10))
    for _ in trainer.run():
        pass
    return trainer


@pytest.fixture
def saved(tmp_path, trained, scene):
    path = tmp_path / module.CHECKPOINT_FILE
    save_checkpoint(path, trained.model, scene=scene, config={"lr": 0.1, "name": "x"}, training=trained.state_dict())
    return path


def same(a, b) -> bool:
    """Equal nested values; tensors bit for bit, lists and tuples alike."""
    if isinstance(a, torch.Tensor):
        return isinstance(b, torch.Tensor) and a.dtype == b.dtype and torch.equal(a, b)
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and a == b


def test_everything_comes_back(saved, trained, scene):
    loaded = load_pretrained(saved)
    assert same(dict(loaded.model.state_dict()), dict(trained.model.state_dict()))
    assert loaded.model.description() == trained.model.description()
    for name, normalizer in trained.model.named_modules():
        if hasattr(normalizer, "inverse_std"):  # derived, not stored
            assert torch.equal(loaded.model.get_submodule(name).inverse_std, normalizer.inverse_std)
    assert same(loaded.training, trained.state_dict())
    assert loaded.config == {"lr": 0.1, "name": "x"}
    assert loaded.versions == package_versions()
    assert loaded.scene().fingerprint() == scene.fingerprint()
    state = torch.zeros(4, 2, 13, dtype=torch.float64)
    state[..., 3] = 1
    action = torch.ones(4, 1)
    predicted = loaded.model.bind(loaded.scene(), strict=True).step(state, action)[0]
    assert torch.equal(predicted, trained.model.bind(scene).step(state, action)[0])


def test_weights_stored_in_half_precision_compute_in_single(tmp_path, trained):
    halves = copy.deepcopy(trained.model).half()
    save_checkpoint(tmp_path / "published.safetensors", halves)
    loaded = load_pretrained(tmp_path / "published.safetensors").model.state_dict()
    assert {value.dtype for name, value in loaded.items() if name.endswith(".weight")} == {torch.float32}
    assert all(torch.equal(loaded[name], value.to(loaded[name].dtype)) for name, value in halves.state_dict().items())


def test_optimizers_keep_integer_keys_and_exact_rates(saved, trained, make_trainer):
    state = load_pretrained(saved).training["optimizer"]
    before = trained.optimizer.state_dict()
    for index in ("0", "1"):
        assert list(state[index]["state"]) == list(before[index]["state"]) == list(range(len(state[index]["state"])))
        assert [g["lr"] for g in state[index]["param_groups"]] == [g["lr"] for g in before[index]["param_groups"]]
    again = make_trainer(Budget(steps=10)).optimizer
    again.load_state_dict(state)
    assert same(again.state_dict(), before)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_weights_keep_their_dtype(tmp_path, make_model, scene, dtype):
    model = make_model().to(dtype)
    save_checkpoint(tmp_path / "c.safetensors", model, scene=scene)
    loaded = load_pretrained(tmp_path / "c.safetensors")
    assert same(dict(loaded.model.state_dict()), dict(model.state_dict()))
    assert loaded.training == {}


def test_nested_training_state_comes_back(tmp_path, make_model, scene):
    training = {
        "scalars": {
            "int": 3,
            "float": 0.1,
            "tiny": 5e-324,
            "none": None,
            "flag": True,
            "text": "ünï",
            "inf": math.inf,
        },
        "tensors": [
            torch.arange(3),
            torch.tensor(2.5),
            torch.zeros(0, 4),
            torch.tensor([True]),
            torch.ones(2).bfloat16(),
        ],
        "keys": {0: {1: torch.zeros(1)}, "a.b": [1, [2.0, {}], []]},
        "bytes": torch.Generator().manual_seed(3).get_state(),
        "view": torch.arange(12.0).view(3, 4).T[1:],
    }
    save_checkpoint(tmp_path / "c.safetensors", make_model(), scene=scene, training=training)
    assert same(load_pretrained(tmp_path / "c.safetensors").training, training)


def test_the_file_is_safetensors_and_holds_no_pickle(saved):
    with safe_open(saved, framework="pt") as file:
        metadata = file.metadata()
        description = json.loads(file.get_tensor("description").numpy().tobytes())
        assert any(name.startswith("model.core.") for name in file.keys())
    assert metadata["format"] == str(module.FORMAT)
    assert {"torch", "mujoco", "torchrl_gn"} <= set(description["versions"])


def test_a_run_folder_stands_for_the_checkpoint_in_it(tmp_path, saved, trained):
    for path in (tmp_path, (tmp_path / module.CHECKPOINT_FILE).parent, tmp_path / module.CHECKPOINT_FILE):
        assert same(dict(load_pretrained(path).model.state_dict()), dict(trained.model.state_dict()))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_agent_comes_back_with_its_statistics(tmp_path, dtype):
    torch.manual_seed(0)
    sizes = {"latent": 4, "hidden": [8]}
    options = {"policy": "graph", "model": "gn", "learned_reward": True, "hidden": [8]}
    agent = Agent(ObservationGraph.swimmer(3), model_options=sizes, policy_options=sizes, **options).to(dtype)
    observation, action, after = torch.randn(20, 13), torch.rand(20, 2), torch.randn(20, 13)
    agent.update_normalizers(observation, action, after)
    save_checkpoint(tmp_path / "c.safetensors", agent)
    loaded = load_pretrained(tmp_path / "c.safetensors")
    again = loaded.agent
    assert loaded.scenes() == [] and same(dict(again.state_dict()), dict(agent.state_dict()))
    td = TensorDict({"observation": observation.to(dtype)}, [20])
    chosen = [each.value(each.policy(td.clone())) for each in (agent, again)]
    assert (chosen[0] == chosen[1]).all()
    assert agent.model is not None and again.model is not None
    assert torch.equal(again.model.step(observation, action), agent.model.step(observation, action))
    with pytest.raises(CheckpointError, match="holds Agent, not ForwardModel"):
        _ = loaded.model


def test_a_checkpoint_prints_what_it_holds(tmp_path):
    scene = load_scene("pendulum")
    model = ForwardModel.for_scene(scene, hidden=8)
    save_checkpoint(tmp_path / "a.safetensors", model, scene=scene, training={"big": torch.zeros(999)})
    text = repr(load_pretrained(tmp_path / "a.safetensors"))
    assert text.startswith("Checkpoint(ForwardModel, scenes=['pendulum'], metrics={}, torchrl_gn 0")
    assert "tensor" not in text


@pytest.mark.parametrize("source", [None, ["cheetah", "pendulum"]])
def test_one_name_or_path_is_loaded(source):
    with pytest.raises(TypeError, match="load_pretrained takes one model, a name or a path; got "):
        load_pretrained(source)


def test_a_model_is_no_agent(saved):
    with pytest.raises(CheckpointError, match="holds ForwardModel, not Agent"):
        _ = load_pretrained(saved).agent


def refused(path, message: str) -> None:
    with pytest.raises(CheckpointError, match=message) as caught:
        load_pretrained(path)
    assert str(path) in str(caught.value)


def test_missing_files(tmp_path):
    refused(tmp_path / "no.safetensors", "no checkpoint at")
    with pytest.raises(CheckpointError, match=f"No checkpoint at .*{module.CHECKPOINT_FILE}"):
        load_pretrained(tmp_path)


def test_files_that_are_not_ours(tmp_path):
    path = tmp_path / "other.safetensors"
    save_file({"x": torch.zeros(3)}, path)
    refused(path, "is a safetensors file, but no checkpoint of torchrl_gn")
    path.write_text("hello, this is plain text and no checkpoint at all")
    refused(path, "damaged")
    torch.save({"x": torch.zeros(3)}, path)
    refused(path, "damaged")


def test_a_model_of_several_scenes_names_them(tmp_path, make_model, scene):
    path = tmp_path / "several.safetensors"
    save_checkpoint(path, make_model(), scene=[scene, load_scene("swimmer3")])
    loaded = load_pretrained(path)
    assert [each.name for each in loaded.scenes()] == [scene.name, "swimmer3"]
    with pytest.raises(CheckpointError, match="several scenes, .*'swimmer3'.*; say which one"):
        loaded.scene()


def test_a_checkpoint_without_a_scene_says_how_to_save_it(tmp_path, make_model):
    save_checkpoint(tmp_path / "none.safetensors", make_model())
    with pytest.raises(CheckpointError, match=r"holds no scene: .* save_checkpoint\(path, model, scene=scene\)"):
        load_pretrained(tmp_path / "none.safetensors").scene()


def test_prints_the_names_of_its_scenes(tmp_path, make_model, scene):
    tree = KinematicTree("arm", ("elbow",), timestep=0.01, commands=((0,),))
    for known in (scene, tree):
        save_checkpoint(tmp_path / "c.safetensors", make_model(), scene=known)
        assert f"scenes=['{known.name}']" in repr(load_pretrained(tmp_path / "c.safetensors"))


def test_what_cannot_be_stored_is_named_and_leaves_the_old_file(saved, make_model, scene):
    content = saved.read_bytes()
    with pytest.raises(TypeError, match=r"entry training\.a\.1 has type object; only tensors and plain values fit"):
        save_checkpoint(saved, make_model(), scene=scene, training={"a": [1, object()]})
    with pytest.raises(TypeError, match="Config and metrics .* plain values, not object"):
        save_checkpoint(saved, make_model(), scene=scene, config={"a": object()})
    assert saved.read_bytes() == content
    assert list(saved.parent.iterdir()) == [saved]


def test_a_full_disk_is_named_and_leaves_the_old_file(saved, make_model, scene, files_end_at):
    content = saved.read_bytes()

    with files_end_at(1000):
        with pytest.raises(
            OSError, match=r"checkpoint\.safetensors cannot be written: File too large.*free some space"
        ):
            save_checkpoint(saved, make_model(1), scene=scene)
    assert saved.read_bytes() == content
    assert list(saved.parent.iterdir()) == [saved]


def test_meshes_are_beside_the_header(tmp_path):
    triangles = np.zeros(6000, dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("flags", "<u2")])
    triangles["corners"] = np.random.default_rng(0).normal(size=(6000, 3, 3))
    (tmp_path / "m.stl").write_bytes(b"\0" * 80 + struct.pack("<I", 6000) + triangles.tobytes())
    (tmp_path / "robot.xml").write_text(
        '<mujoco><asset><mesh name="m" file="m.stl" inertia="shell"/></asset><worldbody><body><joint/>'
        '<geom size="0.1"/><geom type="mesh" mesh="m" contype="0" conaffinity="0" mass="0"/></body></worldbody>'
        "</mujoco>"
    )
    scene = load_scene(tmp_path / "robot.xml")
    save_checkpoint(tmp_path / "c.safetensors", ForwardModel.for_scene(scene, hidden=8), scene=scene)
    content = (tmp_path / "c.safetensors").read_bytes()
    assert struct.unpack("<Q", content[:8])[0] < 10_000 and len(content) > 200_000
    (tmp_path / "m.stl").unlink()
    assert load_pretrained(tmp_path / "c.safetensors").scene().fingerprint() == scene.fingerprint()


def test_a_description_in_the_header_is_read_as_before(tmp_path, saved, trained):
    with safe_open(saved, framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}
    text = tensors.pop("description").numpy().tobytes().decode()
    old = tmp_path / "old.safetensors"
    save_file(tensors, old, {"format": "4", "description": text, "sha256": digest_of(tensors, text)})
    assert same(load_pretrained(old).training, trained.state_dict())
    save_file(
        tensors, old, {"format": "4", "description": text.replace("0.1", "0.2"), "sha256": digest_of(tensors, text)}
    )
    refused(old, "damaged")


def test_a_predictor_is_saved_with_its_scene(tmp_path, trained, scene):
    save_checkpoint(tmp_path / "bound.safetensors", trained.model.bind(scene))
    loaded = load_pretrained(tmp_path / "bound.safetensors")
    assert same(dict(loaded.model.state_dict()), dict(trained.model.state_dict()))
    assert loaded.scene().fingerprint() == scene.fingerprint()


def test_a_bound_ensemble_is_saved_with_its_scene(tmp_path, make_model, scene):
    ensemble = Ensemble([make_model(), make_model()])
    ensemble.calibration.set(*(torch.rand(size, dtype=torch.float64) for size in ((3, 4), (3, 4), (4,))))
    save_checkpoint(tmp_path / "bound.safetensors", ensemble.bind(scene))
    loaded = load_pretrained(tmp_path / "bound.safetensors")
    assert same(dict(loaded.ensemble.state_dict()), dict(ensemble.state_dict()))
    assert loaded.scene().fingerprint() == scene.fingerprint()
    with pytest.raises(TypeError, match="cannot hold a specialised ensemble; save the bound one"):
        save_checkpoint(tmp_path / "fast.safetensors", specialize(ensemble.bind(scene)))


def test_what_a_checkpoint_cannot_hold_is_refused(tmp_path, trained):
    with pytest.raises(TypeError, match="cannot hold a GNCore; give one of BoundPredictor, BoundEnsemble, ForwardMod"):
        save_checkpoint(tmp_path / "core.safetensors", trained.model.core)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_could_not_be_read_again_is_not_written(tmp_path, make_model, value):
    model, path = make_model(), tmp_path / "c.safetensors"
    save_checkpoint(path, model, training={"step": 1})
    with pytest.raises(ValueError, match=r"'training\.moments\.0' has NaN or Inf; an older one is kept"):
        save_checkpoint(path, model, training={"moments": [torch.tensor([1.0, value])]})
    with pytest.raises(TypeError, match=r"has the key \(1, 2\); only texts and numbers fit"):
        save_checkpoint(path, model, training={"by place": {(1, 2): 3}})
    with torch.no_grad():
        next(model.core.parameters()).view(-1)[0] = value
    with pytest.raises(ValueError, match="'model.core.* has NaN or Inf"):
        save_checkpoint(path, model)
    assert load_pretrained(path).training == {"step": 1}


class Adapter(nn.Module):
    def __init__(self, linear: nn.Linear) -> None:
        super().__init__()
        self.linear, self.low_rank = linear, nn.Linear(linear.in_features, linear.out_features)

    def forward(self, inputs):
        return self.linear(inputs) + self.low_rank(inputs)


def add_adapter(mlp):
    mlp[0] = Adapter(mlp[0])


def add_dropout(mlp):
    mlp[1] = nn.Sequential(mlp[1], nn.Dropout(0.5))


def change_activation(mlp):
    mlp[1] = nn.Tanh()


@pytest.mark.parametrize(
    "change",
    [
        add_adapter,
        add_dropout,
        change_activation,
        lambda mlp: parametrizations.weight_norm(mlp[0]),
        lambda mlp: parametrizations.spectral_norm(mlp[0]),
        lambda mlp: prune.l1_unstructured(mlp[0], "weight", amount=0.3),
    ],
    ids=["adapter", "dropout", "activation", "weight norm", "spectral norm", "pruning"],
)
@pytest.mark.parametrize("kind", ["model", "policy"])
def test_a_changed_network_is_not_written_as_an_unchanged_one(saved, make_model, scene, change, kind):
    content = saved.read_bytes()
    model = make_model() if kind == "model" else StatePolicy(scene, hidden=[8, 8])
    change(model.core.first.edge_mlp if kind == "model" else model.network.rest)
    with pytest.raises(ValueError, match="would be read as another network: '(core.first.edge_mlp|network.rest).[01]"):
        save_checkpoint(saved, model)
    assert saved.read_bytes() == content


def test_merged_pruning_is_written(tmp_path, scene):
    policy, state = StatePolicy(scene, hidden=[8, 8]), torch.randn(5, 2, 13)
    prune.l1_unstructured(policy.network.rest[0], "weight", amount=0.3)
    pruned = policy.act(state)
    prune.remove(policy.network.rest[0], "weight")
    save_checkpoint(tmp_path / "c.safetensors", policy)
    assert torch.equal(load_pretrained(tmp_path / "c.safetensors").policy.act(state), pruned)


def test_hooks_are_named_and_saving_draws_no_random_number(tmp_path, make_model):
    model = make_model()
    model.core.first.edge_mlp[0].register_forward_hook(lambda *_: None)
    torch.manual_seed(0)
    with pytest.warns(UserWarning, match=r"does not hold the hooks of \['core.first.edge_mlp.0'\]"):
        save_checkpoint(tmp_path / "c.safetensors", model)
    drawn = torch.rand(3)
    torch.manual_seed(0)
    assert torch.equal(drawn, torch.rand(3))


def test_keys_of_training_states_that_look_alike_stay_apart(tmp_path, make_model):
    state = {"a.b": torch.ones(2), "a": {"b": torch.zeros(3)}, 1: torch.tensor(2), "1": torch.tensor(3)}
    save_checkpoint(tmp_path / "c.safetensors", make_model(), training=state)
    assert same(load_pretrained(tmp_path / "c.safetensors").training, state)


def test_scalars_of_numpy_and_torch_are_numbers(tmp_path, make_model):
    config, metrics = {"steps": np.int64(3)}, {"loss": torch.tensor(0.5, requires_grad=True), "error": np.float32(0.25)}
    save_checkpoint(tmp_path / "c.safetensors", make_model(), config=config, metrics=metrics)
    loaded = load_pretrained(tmp_path / "c.safetensors")
    assert loaded.config == {"steps": 3} and loaded.metrics == {"loss": 0.5, "error": 0.25}
