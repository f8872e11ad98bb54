"""Whatever changes weights: a bound model predicts with them as they are, a specialised one as they were."""

from __future__ import annotations

import copy
import multiprocessing
import pickle

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torch.autograd.functional import hessian, hvp
from torch.func import functional_call

from torchrl_gn.dynamics import SpecializedPredictor, specialize
from torchrl_gn.training import make_optimizer
from torchrl_gn.training.muon import Muon

EXECUTORS = ["native", "eager"]


def steps_of(make):
    """Steps of an optimiser along a gradient of ones."""

    def change(model: nn.Module, other: nn.Module) -> None:
        optimizer = make(list(model.core.parameters()))
        for weight in model.core.parameters():
            weight.grad = torch.ones_like(weight)
        optimizer.step()

    return change


def presets(name: str):
    def change(model: nn.Module, other: nn.Module) -> None:
        optimizer = make_optimizer(model.core, name)
        for weight in model.core.parameters():
            weight.grad = torch.ones_like(weight)
        optimizer.step(0, 0.0)

    return change


def assign_data(model: nn.Module, other: nn.Module) -> None:
    for weight, new in zip(model.core.parameters(), other.core.parameters(), strict=True):
        weight.data = new.data.clone()


def write_data(model: nn.Module, other: nn.Module) -> None:
    for weight in model.core.parameters():
        weight.data.mul_(1.1)


def from_vector(model: nn.Module, other: nn.Module) -> None:
    vector = nn.utils.parameters_to_vector(other.core.parameters()).detach()
    nn.utils.vector_to_parameters(vector, model.core.parameters())


@torch.no_grad()
def average(model: nn.Module, other: nn.Module) -> None:
    torch._foreach_lerp_(list(model.core.parameters()), list(other.core.parameters()), 0.5)


def load(model: nn.Module, other: nn.Module) -> None:
    model.load_state_dict(other.state_dict())


def load_assigned(model: nn.Module, other: nn.Module) -> None:
    model.core.load_state_dict(copy.deepcopy(other.core.state_dict()), assign=True)


def exchange(model: nn.Module, other: nn.Module) -> None:
    model.core = copy.deepcopy(other.core)


CHANGES = {
    "fused Adam": steps_of(lambda weights: torch.optim.Adam(weights, lr=1e-2, fused=True)),
    "foreach AdamW": steps_of(lambda weights: torch.optim.AdamW(weights, lr=1e-2, foreach=True)),
    "SGD": steps_of(lambda weights: torch.optim.SGD(weights, lr=1e-2)),
    "Muon": steps_of(lambda weights: Muon([each for each in weights if each.ndim == 2])),
    **{f"preset {name}": presets(name) for name in ("muon", "adam", "paper")},
    **{each.__name__: each for each in (assign_data, write_data, from_vector, average, load, load_assigned, exchange)},
}


@pytest.fixture
def case(scenes, make_model, random_states, random_actions):
    """A scene's two models with the same statistics, and what predicts from some states."""
    scene = scenes["pendulum"]
    models = [make_model(scene, latent=8, hidden=(12,)) for _ in range(2)]
    with torch.no_grad():
        for weight in models[1].core.parameters():
            weight.mul_(0.8)
    state, actions = random_states(scene, 5), random_actions(scene, 5, 3)

    def predict(predictor):
        with torch.no_grad():
            return predictor.rollout(state, actions)[0]

    return scene, *models, predict, (state, actions)


def close(found, expected) -> bool:
    return bool((found - expected).norm() <= 1e-6 * (expected - expected[:, :1]).norm())


@pytest.mark.parametrize("executor", EXECUTORS)
@pytest.mark.parametrize("name", CHANGES)
def test_live_and_snapshot(case, name, executor):
    scene, model, other, predict, _ = case
    bound, reference = model.bind(scene), model.bind(scene, reference=True)
    fast = specialize(bound, executor=executor)
    before = predict(reference)
    assert close(predict(bound), before) and close(predict(fast), before)
    CHANGES[name](model, other)
    after = predict(reference)
    assert not close(after, before)
    assert close(predict(bound), after) and close(predict(fast), before)
    fast.refresh(bound)
    assert close(predict(fast), after)


@pytest.mark.parametrize("executor", EXECUTORS)
def test_what_is_done_to_the_buffers_is_done_to_the_model(case, executor):
    scene, model, other, predict, (state, actions) = case
    first, second = (specialize(each.bind(scene), executor=executor) for each in (model, other))
    here, there = predict(first), predict(second)
    buffers = dict(second.named_buffers())
    assert torch.equal(functional_call(first, buffers, (state, actions[:, 0])), second.step(state, actions[:, 0])[0])
    assert torch.equal(predict(first), here)
    stacked = {name: torch.stack(pair) for name, pair in pairs(first, second).items()}
    both = torch.vmap(lambda each: functional_call(first, each, (state, actions[:, 0])))(stacked)
    for one, predictor in zip(both, (first, second), strict=True):
        torch.testing.assert_close(one, predictor.step(state, actions[:, 0])[0], rtol=1e-6, atol=1e-9)
    weights = TensorDict.from_module(second).clone()  # as collectors send them
    weights.to_module(first)
    assert torch.equal(predict(first), there)
    for twin in (copy.deepcopy(second), pickle.loads(pickle.dumps(second))):
        second.load_state_dict(specialize(model.bind(scene), executor=executor).state_dict())
        assert torch.equal(predict(twin), there) and torch.equal(predict(second), here)
        second.load_state_dict(twin.state_dict())


def pairs(first: SpecializedPredictor, second: SpecializedPredictor) -> dict:
    """Trained buffers of two predictors."""
    own, others = first.state_dict(), second.state_dict()
    return {name: (own[name], others[name]) for name in own if own[name].is_floating_point()}


def test_global_modes(case):
    scene, model, _, predict, _ = case
    bound = model.bind(scene)
    for predictor in (bound, specialize(bound), specialize(bound, executor="eager")):
        expected = predict(predictor)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            assert torch.equal(predict(predictor), expected)
        with torch.inference_mode():
            assert torch.equal(predict(predictor), expected)
        torch.set_default_dtype(torch.float64)
        try:
            assert torch.equal(predict(predictor), expected)
        finally:
            torch.set_default_dtype(torch.float32)


def test_second_derivatives_are_right_or_refused(case):
    scene, model, _, _, (state, actions) = case
    bound = model.requires_grad_(False).bind(scene)

    def cost(predictor, plan):
        return predictor.rollout(state[:1], plan.view(1, -1, 1))[0].square().sum() + plan.square().sum() / 2

    plan = actions[0].flatten()
    exact = hessian(lambda plan: cost(model.bind(scene, reference=True), plan), plan)
    assert (exact - torch.eye(len(plan))).norm() > 1e-6
    eager, native = specialize(bound, executor="eager"), specialize(bound)
    for predictor in (bound, eager):
        torch.testing.assert_close(hessian(lambda plan: cost(predictor, plan), plan), exact, rtol=1e-5, atol=1e-7)  # noqa: B023
    by_func = torch.func.hessian(lambda plan: cost(native, plan))(plan)
    torch.testing.assert_close(by_func, exact, rtol=1e-5, atol=1e-7)
    with pytest.raises(RuntimeError, match="of first order"):
        hessian(lambda plan: cost(native, plan), plan)
    with pytest.raises(RuntimeError, match="of first order"):
        hvp(lambda plan: cost(native, plan), plan, torch.ones_like(plan))
    leaf = plan.clone().requires_grad_()
    (slope,) = torch.autograd.grad(cost(native, leaf), leaf, create_graph=True)
    with pytest.raises(RuntimeError, match="of first order"):
        torch.autograd.grad(slope.sum(), leaf, allow_unused=True)


def change_shared(predictor: SpecializedPredictor, weights: dict) -> None:
    predictor.load_state_dict(weights)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.parametrize("executor", EXECUTORS)
def test_processes_that_share_its_memory_see_new_weights(case, executor, method):
    scene, model, other, predict, _ = case
    first, second = (specialize(each.bind(scene), executor=executor) for each in (model, other))
    there = predict(second)
    first.share_memory()
    process = multiprocessing.get_context(method).Process(target=change_shared, args=(first, second.state_dict()))
    process.start()
    process.join()
    assert process.exitcode == 0 and torch.equal(predict(first), there)
