"""Static features go by name: data sets and weights of before serve a library that has gained or reordered some."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from torchrl_gn.data import DatasetError, create_dataset, load_dataset, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel, Predictor, specialize
from torchrl_gn.evaluation import evaluate_errors
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import ParameterNames, load_scene, sample_variants
from torchrl_gn.training import load_pretrained

from ..sizes import SMALL
from ..static_columns import change_columns

SIZES: dict[str, Any] = {"train": 10, "validation": 2, "test": 3, "steps": 6, "variants": 10}
pytestmark = pytest.mark.filterwarnings("error::torchrl_gn.scenes.SceneChangedWarning")


def train_loss(bound: Predictor, data) -> torch.Tensor:
    return ForwardModelLoss(bound)(trajectory_buffer(data, batch_size=30, seed=0).sample())["loss_forward_model"]


def fit(bound: Predictor, data) -> None:
    ForwardModelLoss(bound).fit_normalizers(trajectory_buffer(data, batch_size=50, seed=0).sample())


@pytest.fixture
def model(tmp_path: Path) -> ForwardModel:
    """A model of pendulums, fitted to the data set in the folder."""
    torch.manual_seed(0)
    made = create_dataset(tmp_path / "d", load_scene("pendulum"), **SIZES)
    assert made.features == ParameterNames.of(made.scene)
    model = ForwardModel(made.features, **SMALL).double()
    fit(model.bind(made.scene, parameters_key="parameters"), made.train)
    return model


@pytest.mark.slow
def test_a_data_set_of_before_serves_a_model_of_before(tmp_path, model, monkeypatch):
    before = load_dataset(tmp_path / "d")
    bound = model.bind(before.scene, parameters_key="parameters")
    expected, table = train_loss(bound, before.train), evaluate_errors(bound, before.test, horizons=(5,))
    change_columns(monkeypatch, gain=True)
    for opened in (
        load_dataset(tmp_path / "d"),
        load_dataset(tmp_path / "d", load_scene("pendulum")),
        create_dataset(tmp_path / "d", load_scene("pendulum"), **SIZES),
    ):
        assert opened.features == ParameterNames.of(opened.scene).common(model.parameter_names) != model.parameter_names
        again = model.bind(opened.scene, parameters_key="parameters", parameter_names=opened.features)
        assert torch.equal(train_loss(again, opened.train), expected)
        assert evaluate_errors(again, opened.test, horizons=(5,)).to_metrics() == table.to_metrics()


@pytest.mark.slow
def test_data_collected_now_serve_a_model_of_before(tmp_path, model, monkeypatch):
    before = load_dataset(tmp_path / "d")
    expected = train_loss(model.bind(before.scene, parameters_key="parameters"), before.train)
    variant = sample_variants("pendulum", 1, rng=1)[0]
    state, action = before.train["state"][:3, 0], before.train["action"][:3, 0]
    moved, _ = model.bind(variant).step(state, action)
    change_columns(monkeypatch, gain=True)
    made = create_dataset(tmp_path / "new", load_scene("pendulum"), **SIZES)
    assert made.train["parameters", "nodes"][0, :, 0].tolist() == [1, 2]
    bound = model.bind(made.scene, parameters_key="parameters")
    assert torch.equal(train_loss(bound, made.train), expected)
    # By hand, and in a snapshot.
    variant = sample_variants("pendulum", 1, rng=1)[0]
    parameters = torch.stack([bound.parameters_of(variant)] * 3)
    assert parameters["nodes"].shape[-1] == len(made.features.nodes)
    torch.testing.assert_close(bound.step(state, action, parameters)[0], moved, rtol=0, atol=1e-12)
    model.requires_grad_(False)
    quick = specialize(bound)
    torch.testing.assert_close(quick.step(state, action, parameters)[0], moved, rtol=0, atol=1e-12)
    assert quick.own_parameters()["nodes"].shape[-1] == len(made.features.nodes)


@pytest.mark.slow
def test_columns_in_another_order_are_put_right_when_a_data_set_is_opened(tmp_path, model, monkeypatch):
    before = load_dataset(tmp_path / "d")
    expected = train_loss(model.bind(before.scene, parameters_key="parameters"), before.train)
    change_columns(monkeypatch, gain=False)
    opened = load_dataset(tmp_path / "d")
    assert opened.features == ParameterNames.of(opened.scene) != before.features
    made = create_dataset(tmp_path / "new", load_scene("pendulum"), **SIZES)
    assert torch.equal(opened.train["parameters", "nodes"], made.train["parameters", "nodes"])
    assert torch.equal(train_loss(model.bind(opened.scene, parameters_key="parameters"), opened.train), expected)


def test_what_is_missing_is_named(tmp_path, model, monkeypatch):
    change_columns(monkeypatch, gain=True)
    opened = load_dataset(tmp_path / "d")
    fresh = ForwardModel.for_scene(opened.scene, **SMALL).double()
    with pytest.raises(ValueError, match=r"reads the parameters \['charm'\], which samples of 'pendulum' lack"):
        fresh.bind(opened.scene, parameters_key="parameters", parameter_names=opened.features)
    # The data set's names were not given.
    for each in (fresh, model):
        count = len(opened.features.nodes)
        with pytest.raises(ValueError, match=rf"have {count} static features in 'nodes', not the {count + 1} of scene"):
            fit(each.bind(opened.scene, parameters_key="parameters"), opened.train)
    monkeypatch.undo()
    with pytest.raises(ValueError, match=r"Scene 'pendulum' lacks the static features \['charm'\]"):
        fresh.bind(load_scene("pendulum"))


@pytest.mark.slow
@pytest.mark.usefixtures("small_chunks")
def test_an_unfinished_data_set_is_finished_with_the_columns_it_was_started_with(tmp_path, monkeypatch):
    scene = load_scene("pendulum")

    def interrupt(done: int, _) -> None:
        if done > 4:
            raise KeyboardInterrupt

    create_dataset(tmp_path / "whole", scene, **SIZES)
    with pytest.raises(KeyboardInterrupt):
        create_dataset(tmp_path / "parts", scene, **SIZES, progress=interrupt)
    with monkeypatch.context() as patch:
        change_columns(patch, gain=True)
        finished = create_dataset(tmp_path / "parts", load_scene("pendulum"), **SIZES)
        assert "charm" not in finished.features.nodes
        with pytest.raises(KeyboardInterrupt):
            create_dataset(tmp_path / "gained", load_scene("pendulum"), **SIZES, progress=interrupt)
    for file in (tmp_path / "whole").rglob("*.*"):
        assert file.read_bytes() == (tmp_path / "parts" / file.relative_to(tmp_path / "whole")).read_bytes(), file
    with pytest.raises(DatasetError, match=r"was started with static features \['charm'\]"):
        create_dataset(tmp_path / "gained", scene, **SIZES)


@pytest.mark.parametrize("name", ["pendulum", "swimmerN", "identified_pendulum"])
def test_shipped_weights_serve_a_library_with_more_features(name, monkeypatch):
    def predict() -> list[torch.Tensor]:
        checkpoint = load_pretrained(name)
        predicted = []
        for scene in checkpoint.scenes()[:2]:
            trained = checkpoint.trained.requires_grad_(False)
            bound = trained.bind(scene) if isinstance(trained, ForwardModel) else trained.bind(scene)[0]
            state = torch.eye(13, dtype=torch.float64)[3].expand(scene.num_nodes, 13)
            predicted.append(bound.step(state, torch.ones(scene.num_actions, dtype=torch.float64))[0])
        return predicted

    before = predict()
    change_columns(monkeypatch, gain=True)
    assert all(map(torch.equal, predict(), before))
