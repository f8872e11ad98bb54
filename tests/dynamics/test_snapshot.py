"""A specialised predictor is a value whose only copy are its buffers: casts, copies, loaded and refreshed weights."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable

import pytest
import torch
from torch import nn

from torchrl_gn.dynamics import ForwardModel, SpecializedPredictor, specialize
from torchrl_gn.networks import GNCore
from torchrl_gn.networks.packed_layers import PackedLayers
from torchrl_gn.scenes import load_scene

from .native import equal, vjp

KINDS = ["native", "eager", "recurrent", "variants"]
OPTIONS = {"recurrent": {"core": "recurrent", "hidden_state": (3, 4, 5)}}


@pytest.fixture
def made(scenes, make_model) -> Callable[..., SpecializedPredictor]:
    """A specialised predictor, and the bound one that it was made of."""

    def make(kind: str = "native", dtype=torch.float32, **options):
        scene = scenes["pendulum"]
        model = make_model(scene, **(OPTIONS.get(kind, {}) | options)).to(dtype)
        bound = model.bind(scene, parameters_key="parameters" if kind == "variants" else None)
        return specialize(bound, executor="eager" if kind == "eager" else "native"), bound

    return make


def more_statistics(bound) -> None:
    """Other scales of the same features that vary."""
    for name in ("node", "residual", "delta"):
        normalizer = getattr(bound.model, f"{name}_normalizer")
        changed = {key: 1.1 * each if key != "count" else each for key, each in normalizer.state_dict().items()}
        normalizer.load_state_dict(changed)


@torch.no_grad()
def scale(bound, factor: float = 1.5) -> None:
    for weight in bound.model.core.parameters():
        weight.mul_(factor)


@pytest.mark.parametrize("kind", KINDS)
def test_it_never_follows_its_model_but_by_refresh(made, inputs, kind):
    quick, bound = made(kind, torch.float64)
    state, actions = inputs(quick, 3)
    before, squares = quick.rollout(state, actions)[0].detach(), copy.deepcopy(quick.training_squares())
    scale(bound)
    more_statistics(bound)
    assert torch.equal(quick.rollout(state, actions)[0].detach(), before)
    quick.refresh(bound)
    after = quick.rollout(state, actions)[0]
    assert (after - before).abs().max() > 1e-7
    torch.testing.assert_close(after, bound.rollout(state, actions)[0].detach(), rtol=0, atol=1e-11)
    for name, square in bound.training_squares().items():
        assert torch.equal(quick.training_squares()[name], square)
        assert not square or not torch.equal(square, squares[name])


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda quick: pickle.loads(pickle.dumps(quick))])
@pytest.mark.parametrize("kind", KINDS)
def test_copies_predict_alike_and_share_nothing(made, inputs, copied, kind):
    quick, bound = made(kind)
    state, actions = inputs(quick, 3)
    before = quick.rollout(state, actions)[0]
    twin = copied(quick)
    assert (twin.executor_name, twin.dtype, twin.in_keys, twin.reason, str(twin)) == (
        quick.executor_name,
        quick.dtype,
        quick.in_keys,
        quick.reason,
        str(quick),
    )
    assert torch.equal(twin.rollout(state, actions)[0], before)
    scale(bound)
    twin.refresh(bound)
    assert not torch.equal(twin.rollout(state, actions)[0], before)
    assert torch.equal(quick.rollout(state, actions)[0], before)


@pytest.mark.parametrize("kind", ["native", "eager", "recurrent"])
def test_state_dicts_hold_all_that_training_changes(made, inputs, kind):
    quick, bound = made(kind)
    state, actions = inputs(quick, 3)
    scale(bound)
    more_statistics(bound)
    other = specialize(bound, executor=quick.executor_name)
    expected = other.rollout(state, actions)[0]
    assert not torch.equal(quick.rollout(state, actions)[0], expected)
    assert not any(each.requires_grad for each in quick.parameters())
    quick.load_state_dict(other.state_dict())
    assert torch.equal(quick.rollout(state, actions)[0], expected)
    scene = {"edge_index", "movable", "reference", "standard", "parameters", "controls", "canonicalizer", "projection"}
    assert not any(name.startswith(f"snapshot.{part}") for name in quick.state_dict() for part in scene)


@pytest.mark.parametrize("assign", [False, True])
def test_loaded_weights_are_predicted_with(made, inputs, assign):
    quick, bound = made()
    state, actions = inputs(quick, 3)
    scale(bound)
    other = specialize(bound)
    quick.load_state_dict({name: each.clone() for name, each in other.state_dict().items()}, assign=assign)
    assert equal(vjp(quick, state, actions), vjp(other, state, actions))


BITS = {torch.float64: 1e-6, torch.float32: 1e-5, torch.float16: 2e-2, torch.bfloat16: 0.1}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_casts(made, inputs, kind):
    quick, bound = made(kind)
    state, actions = inputs(quick, 3)
    reference = bound.rollout(state, actions)[0].detach()
    change = (reference - state[:, None]).norm()
    scale(bound, 1.0)
    for dtype in (torch.float64, torch.bfloat16, torch.float64, torch.float16, torch.bfloat16, torch.float32):
        quick.to(dtype)
        assert quick.dtype == dtype
        for refreshed in (False, True):
            if refreshed:
                quick.refresh(bound)
            found = quick.rollout(state, actions)[0]
            assert found.dtype == torch.float64
            # Digits that were lost come back with a refresh.
            assert (found - reference).norm() <= (BITS[dtype] if refreshed else 0.1) * change, dtype
            numbers = [each for name, each in quick.named_buffers() if "core" not in name and "static" not in name]
            network = {torch.float16, torch.bfloat16} if kind == "variants" else set()
            floats = {each.dtype for each in numbers if each.is_floating_point()} - {torch.float32} - network
            assert floats == {torch.float64}
    torch.testing.assert_close(quick.rollout(state, actions)[0], specialize(bound).rollout(state, actions)[0])


def test_a_cast_keeps_running_natively(made, inputs, calls):
    quick, _ = made()
    state, actions = inputs(quick, 3)
    expected = quick.rollout(state, actions)[0]
    quick.double()
    by_torch = calls(PackedLayers, "predict")
    found = quick.rollout(state, actions)[0]
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)
    assert not by_torch and quick.program().core.weights.dtype == torch.float64


@pytest.mark.slow
def test_prepared_steps_keep_their_weights(scenes, make_model, inputs):
    """Folding for samples copies no frozen float64 core, but the prepared step is a snapshot."""
    scene = scenes["pendulum"]
    bound = make_model(scene, edge_hidden=(5, 5)).double().bind(scene, parameters_key="parameters")
    quick = specialize(bound, executor="eager")
    state, actions = inputs(quick, 3)
    prepared = quick.prepared(quick.own_parameters())
    before = prepared.rollout(state, actions)[0]
    scale(bound)
    quick.refresh(bound)
    assert torch.equal(prepared.rollout(state, actions)[0], before)
    after = quick.prepared(quick.own_parameters()).rollout(state, actions)[0]
    assert (after - before).abs().max() > 1e-7


def test_refresh_into_another_dtype(made, inputs):
    """A bound model in one dtype refreshes a specialised one of another."""
    quick, bound = made()
    wide = specialize(bound, dtype=torch.float64)
    scale(bound)
    state, actions = inputs(quick, 3)
    for each in (quick, wide):
        each.refresh(bound)
    assert torch.equal(quick.rollout(state, actions)[0], specialize(bound).rollout(state, actions)[0])
    again = specialize(bound, dtype=torch.float64)
    assert torch.equal(wide.rollout(state, actions)[0], again.rollout(state, actions)[0])


REFUSED = {
    "other layers": {"edge_hidden": (9,)},
    "another activation": {"activation": "tanh"},
    "no projection": {"project": False},
    "another core": {"core": "mlp"},
    "rates that are not integrated": {"integrate": False},
}


@pytest.mark.parametrize("kind", REFUSED)
def test_weights_of_another_form_are_refused(made, make_model, inputs, kind):
    quick, bound = made()
    state, actions = inputs(quick, 3)
    before = quick.rollout(state, actions)[0]
    options = REFUSED[kind]
    plain = {"latent": 6, "edge_hidden": (8,), "node_hidden": (8,), "global_hidden": (8,)} | options
    plain = {"hidden": (8,)} | options if options.get("core") == "mlp" else plain
    torch.manual_seed(0)
    other = ForwardModel.for_scene(bound.scene, **plain)
    for name in ("node", "edge", "residual", "delta", "parameter_node", "parameter_edge", "parameter_global"):
        own, given = (getattr(each, f"{name}_normalizer") for each in (other, bound.model))
        own.load_state_dict(given.state_dict())
    with pytest.raises(ValueError, match="cannot take these weights.*Specialise it anew"):
        quick.refresh(other.bind(bound.scene))
    assert torch.equal(quick.rollout(state, actions)[0], before)


@pytest.mark.filterwarnings("ignore::torchrl_gn.dynamics.UnseenParameterWarning")
def test_another_scene_or_other_features_that_vary_are_refused(made, inputs):
    quick, bound = made()
    state, actions = inputs(quick, 3)
    before = quick.rollout(state, actions)[0]
    refused = pytest.raises(ValueError, match="cannot take these weights")
    with refused:
        quick.refresh(bound.model.bind(load_scene("pendulum", timestep=0.04)))
    quick.refresh(bound.model.bind(load_scene("pendulum")))  # the same system from another object
    normalizer = bound.model.node_normalizer
    m2 = normalizer.m2.clone()
    m2[m2.nonzero()[0]] = 0.0
    normalizer.load_state_dict({"count": normalizer.count, "mean": normalizer.mean, "m2": m2})
    with refused:
        quick.refresh(bound)
    assert torch.equal(quick.rollout(state, actions)[0], before)


def test_only_bound_models_are_specialised(made, scenes):
    quick, bound = made()
    with pytest.raises(TypeError, match="takes a bound model, not SpecializedPredictor"):
        specialize(quick)  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match="ForwardModel is not bound to a scene"):
        specialize(bound.model)
    with pytest.raises(TypeError):
        specialize(nn.Linear(1, 1))  # pyright: ignore[reportArgumentType]


def test_a_prediction_folds_nothing(made, inputs, folds):
    quick, _ = made()
    state, actions = inputs(quick, 3)
    folds.clear()
    quick.rollout(state, actions)
    quick.step(state, actions[:, 0])
    quick.delta(state, actions[:, 0])
    quick.prepared(size=1000).rollout(state, actions)
    assert not folds


def test_a_bound_model_folds_once_a_rollout(made, inputs, folds):
    _, bound = made()
    state, actions = inputs(bound, 3)
    folds.clear()
    bound.rollout(state, actions)
    assert len(folds) == 1 and isinstance(folds[0], GNCore)
    bound.step(state, actions[:, 0])
    assert len(folds) == 2
    prepared = bound.prepared()
    for index in range(3):
        state = prepared.step(state, actions[:, index])[0]
    assert len(folds) == 3


@pytest.mark.slow
def test_inference_mode_leaves_nothing_behind(scenes, make_model, inputs):
    """Folded inside, differentiated outside; and values made inside are never taken for the same."""
    scene = scenes["swimmer6"]
    bound = make_model(scene).double().bind(scene, parameters_key="parameters")
    quick = specialize(bound)
    state, actions = inputs(quick, 3)
    action = actions[:, 0]
    with torch.inference_mode():
        parameters = bound.parameters_of(scene).clone()
        quick.step(state, action, parameters)
        parameters["nodes"].mul_(1.5)
        torch.testing.assert_close(quick.step(state, action, parameters)[0], bound.step(state, action, parameters)[0])
    found, expected = (vjp(each, state, actions) for each in (quick, bound))
    torch.testing.assert_close(found[0], expected[0])
    torch.testing.assert_close(found[2], expected[2])
