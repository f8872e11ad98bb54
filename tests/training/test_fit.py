"""Training in one call: it learns, is reproducible, and returns its history."""

from __future__ import annotations

import importlib
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchrl_gn as gn
from torchrl_gn.training import History, Progress, Trainer

module = importlib.import_module("torchrl_gn.training.fit")  # the folder's name is the function's


@pytest.fixture
def train(scene, trajectories, make_model):
    """Fit a small model of the pendulum, by default a new one; return the model and its history."""

    def train(model=None, data=trajectories, **options):
        model = make_model().bind(scene) if model is None else model
        return model, gn.fit(model, data, progress=False, **options)

    return train


def weights(model) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in model.model.core.state_dict().items()}


def normalizers(model) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in model.model.state_dict().items() if "normalizer" in name}


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


@pytest.mark.slow
def test_the_loss_falls_and_predictions_improve(train, scene):
    test = gn.collect_trajectories(scene, 5, 20, seed=1)
    model, history = train(steps=1)
    before = gn.evaluate_errors(model, test, horizons=(20,))
    _, more = train(model, steps=150)
    after = gn.evaluate_errors(model, test, horizons=(20,))
    assert more.losses[-1] < 0.3 * history.losses[0]
    for name in ("one_step_error", "rollout_error_20"):
        assert after[name].total < 0.5 * before[name].total


@pytest.mark.slow
def test_a_seed_decides_batches_and_noise(train, make_model, scene):
    trained = []
    for seed, others in ((0, 0), (0, 1), (1, 0)):
        found = []
        for noise in (0.0, 0.1):
            model = make_model().bind(scene)
            torch.manual_seed(others)
            train(model, steps=4, seed=seed, noise=noise)
            found.append(weights(model))
        assert not same(*found)
        trained.append(found)
    assert all(map(same, trained[0], trained[1]))
    assert not any(map(same, trained[0], trained[2]))


@pytest.mark.parametrize("preset", ["muon", "adam", "paper"])
def test_presets_train(train, make_model, scene, preset):
    (model, _), (faster, history) = train(steps=3, optimizer=preset), train(steps=3, optimizer=preset, lr=0.05)
    fresh = weights(make_model().bind(scene))
    for each in (model, faster):
        moved = weights(each)
        assert all(not torch.equal(moved[name], fresh[name]) for name in fresh)
    assert not same(weights(model), weights(faster)) and len(history.losses) == 3


def test_an_optimiser_of_torch_trains_with_its_own_rate(train, make_model, scene):
    made = []

    def sgd(parameters):
        made.append(torch.optim.SGD(parameters, lr=0.125))
        return made[0]

    model, _ = train(steps=3, optimizer=sgd)
    assert [group["lr"] for group in made[0].param_groups] == [0.125]
    assert not same(weights(model), weights(make_model().bind(scene)))


def test_what_does_not_fit_is_named_and_changes_nothing(train, make_model, scene):
    model = make_model().bind(scene)
    before = {name: value.clone() for name, value in model.model.state_dict().items()}
    with pytest.raises(ValueError, match="lr=0.1 is for presets; give .*SGD.* its learning rate yourself"):
        train(model, steps=2, lr=0.1, optimizer=torch.optim.SGD)
    with pytest.raises(ValueError, match=r"preset 'adagrad' is not known; use one of \['muon', 'adam', 'paper'\]"):
        train(model, steps=2, optimizer="adagrad")
    with pytest.raises(ValueError, match="steps=0"):
        train(model, steps=0)
    with pytest.raises(ValueError, match="noise=-1"):
        train(model, steps=2, noise=-1)
    with pytest.raises(TypeError, match=r"optimizer takes a preset or a function: lambda weights: torch.optim.SGD\("):
        train(model, steps=2, optimizer=torch.optim.SGD(model.parameters(), lr=0.1))
    other = gn.collect_trajectories("acrobot", 2, steps=3)
    with pytest.raises(ValueError, match=r"States of scene 'pendulum' must be \[M, T \+ 1, 2, 13\], got \[.*, 3, 13\]"):
        train(model, data=other, steps=2)
    frozen = make_model().requires_grad_(False).bind(scene)
    for optimizer in ("muon", "adam", torch.optim.Adam):
        with pytest.raises(ValueError, match="ForwardModel has no weight that requires a gradient: there is nothing"):
            train(frozen, steps=2, optimizer=optimizer)
    with pytest.raises(TypeError, match="LBFGS needs a closure .* use an optimiser for random batches"):
        train(model, steps=2, optimizer=torch.optim.LBFGS)
    assert same(model.model.state_dict(), before)


def test_integers_of_numpy_are_whole_numbers(train, trajectories):
    model = gn.ForwardModel.for_scene("pendulum", hidden=np.int64(8), layers=np.int64(1)).bind("pendulum")
    layers = [layer for layer in model.model.core.modules() if isinstance(layer, torch.nn.Linear)]
    assert layers[0].weight.shape[0] == 8
    train(model, steps=np.int64(2), batch_size=np.int64(5), seed=np.int64(0))


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_it_trains_without_gradients_around_it(train, make_model, scene, mode):
    usual, _ = train(steps=3)
    model = make_model().bind(scene)
    with mode():
        train(model, steps=3)
    assert same(weights(model), weights(usual))
    train(model, steps=1)  # nothing belongs to inference mode


def test_a_model_that_is_not_bound_is_refused(make_model, trajectories):
    model = make_model()
    calls = (
        lambda: gn.fit(model, trajectories, steps=1),
        lambda: gn.evaluate_errors(model, trajectories),
        lambda: gn.specialize(model),
        lambda: gn.ModelEnv(model),
    )
    for call in calls:
        with pytest.raises(TypeError, match=r"ForwardModel is not bound to a scene: use model\.bind\(scene\)"):
            call()


def test_a_specialised_predictor_is_refused(train):
    model, _ = train(steps=1)
    before = weights(model)
    with pytest.raises(TypeError, match="specialised model passes no gradient to the weights"):
        train(gn.specialize(model), steps=2)
    assert same(weights(model), before)


@pytest.mark.slow
def test_steps_and_minutes_end_it(train, calls):
    _, history = train(steps=7)
    assert history.steps == list(range(1, 8))
    _, history = train(minutes=0.2 / 60)
    assert 0.2 <= history.seconds[-1] < 5 and history.steps[-1] > 1
    _, history = train(minutes=0.2 / 60, steps=10**6)
    assert 0.2 <= history.seconds[-1] < 5
    _, history = train(minutes=5, steps=3)
    assert history.steps == [1, 2, 3]
    budgets = calls(module, "Budget", lambda **limits: limits)
    with pytest.raises(ZeroDivisionError):
        train(optimizer=lambda parameters: 1 / 0)
    assert budgets == [{"steps": None, "minutes": 1.0}]


@pytest.mark.slow
def test_validation_keeps_the_best_weights(train, trajectories, monkeypatch):
    seen, errors = [], iter([5.0, 3.0, 1.0, float("nan"), *[2.0] * 16])

    def measured(model, validation, *, horizons, one_step):
        assert validation is trajectories and horizons == (20,) and not one_step
        seen.append(weights(model))
        return SimpleNamespace(errors={"rollout_error_20": SimpleNamespace(total=next(errors))})

    monkeypatch.setattr(module, "evaluate_errors", measured)
    model, history = train(steps=40, validation=trajectories)
    assert [step for step, _ in history.validations] == list(range(2, 41, 2))
    assert [error for _, error in history.validations[:3]] == [5.0, 3.0, 1.0]
    assert same(weights(model), seen[2]) and not same(seen[2], seen[-1])
    assert "best validation error 1.00e+00" in str(history)


@pytest.mark.slow
def test_validation_errors_are_those_of_the_model(train, scene):
    validation = gn.collect_trajectories(scene, 3, 20, seed=2)
    model, history = train(steps=20, validation=validation)
    table = gn.evaluate_errors(model, validation, horizons=(20,))
    best = min(error for _, error in history.validations)
    assert table["rollout_error_20"].total == pytest.approx(best, rel=1e-4)


def test_the_history_has_a_hundred_points_of_mean_losses(train, monkeypatch):
    def run(trainer):
        for step in range(1, 251):
            yield Progress(step, 0.5 * step, step / 250, float(step))

    monkeypatch.setattr(Trainer, "run", run)
    _, history = train(steps=250)
    assert len(history.steps) == len(history.seconds) == len(history.losses) == 100
    assert history.steps[-1] == 250 and history.seconds == [0.5 * step for step in history.steps]
    starts = [0, *history.steps[:-1]]
    # Of the steps from the one after the last point on.
    assert history.losses == [(first + 1 + last) / 2 for first, last in zip(starts, history.steps, strict=True)]
    assert {last - first for first, last in zip(starts, history.steps, strict=True)} <= {2, 3}
    assert str(history) == f"250 steps in 125 s, loss {history.losses[0]:.2e} to {history.losses[-1]:.2e}"
    assert history.validations == [] and str(History()) == "no step"
    assert repr([history]) == f"[History({history})]"  # what a notebook shows of fit_ensemble's


@pytest.mark.slow
def test_a_second_fit_goes_on_with_the_same_normalisers(train, scene):
    model, first = train(steps=100)
    statistics, trained = normalizers(model), weights(model)
    _, second = train(model, gn.collect_trajectories(scene, 30, 20, seed=3), steps=10, noise=0.01, lr=1e-4)
    assert same(normalizers(model), statistics) and not same(weights(model), trained)
    assert second.losses[0] < 0.5 * first.losses[0]


def test_motion_that_the_normalisers_never_saw_is_refused(train, trajectories):
    still = trajectories.clone()
    still["state"] = still["state"][:, :1].expand_as(still["state"]).contiguous()
    model, _ = train(data=still, steps=1)
    train(model, still, steps=1)
    with pytest.raises(ValueError, match="'orientation' never changed in the model's first training data"):
        train(model, steps=1)  # it learned nothing, and said nothing
    train(train(steps=1)[0], still, steps=1)


def test_a_loss_that_is_not_finite_stops_it(train, make_model, scene):
    model = make_model().bind(scene)
    with pytest.raises(FloatingPointError, match="not finite at step|The loss is (nan|inf) at step"):
        train(model, steps=50, optimizer=lambda parameters: torch.optim.SGD(parameters, lr=1e30))
    assert all(value.isfinite().all() for value in weights(model).values())


@pytest.mark.slow
def test_the_front_door():
    """The first lines that a user types."""
    scene = gn.load_scene("swimmer6")
    model = gn.ForwardModel.for_scene(scene).bind(scene)
    gn.fit(model, gn.collect_trajectories(scene, 100, seed=0), steps=3)
    assert "rollout 100" in str(gn.evaluate_errors(model, gn.collect_trajectories(scene, 10, seed=1)))
    fast = gn.specialize(gn.load_pretrained("swimmer6").bind(scene))
    test = gn.collect_trajectories(scene, 2, seed=1)
    assert gn.evaluate_errors(fast, test)["rollout_error_100"].total < 0.01
