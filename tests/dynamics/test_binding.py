"""Single steps called without ctypes: the same bits, and the general way wherever they do not apply."""

from __future__ import annotations

import copy
import gc
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch.autograd import forward_ad
from torch.utils.flop_counter import FlopCounterMode
from torchrl_gn.dynamics.executors.native.binding import load_binding

from torchrl_gn.dynamics import specialize
from torchrl_gn.dynamics.predictor import Predictor

pytestmark = pytest.mark.skipif(load_binding() is None, reason="there are no headers or no C++ compiler")


@pytest.fixture
def quick(scenes, make_model):
    def make(name: str = "swimmer6", dtype=torch.float32):
        return specialize(make_model(scenes[name]).to(dtype).requires_grad_(False).bind(scenes[name]))

    return make


@pytest.fixture
def inputs(random_states, random_actions):
    def draw(predictor, *batch: int, dtype=torch.float64):
        scene = predictor.scene
        return random_states(scene, *batch).to(dtype), random_actions(scene, *batch).to(dtype)

    return draw


@pytest.fixture
def general_steps(monkeypatch) -> list:
    """States of steps that went the general way."""
    steps, step = [], Predictor.step

    def counted(self, state, *arguments):
        steps.append(state)
        return step(self, state, *arguments)

    monkeypatch.setattr(Predictor, "step", counted)
    return steps


@pytest.mark.parametrize("name", ["swimmer6", "cheetah", "joints"])
@pytest.mark.parametrize("state_dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_all_bits_are_the_same(quick, inputs, general_steps, name, dtype, state_dtype):
    predictor = quick(name, dtype)
    for batch in ((), (1,), (3,), (2, 3), (60,)):
        state, action = inputs(predictor, *batch, dtype=state_dtype)
        expected = predictor.executor().step(state, action)[0]
        predictor.step(state, action)
        general_steps.clear()
        found, hidden = predictor.step(state, action)
        assert torch.equal(found, expected) and hidden is None and found.dtype == state_dtype
        assert not general_steps


@pytest.mark.parametrize(
    "change",
    [
        lambda model: next(model.parameters()).mul_(1.5),
        lambda model: model.load_state_dict({name: 1.5 * value for name, value in model.state_dict().items()}),
        lambda model: model.half(),
        lambda model: model.core.half(),
        lambda model: model.delta_normalizer.update(torch.randn(50, 12, dtype=torch.float64)),
    ],
)
@pytest.mark.filterwarnings("ignore::torchrl_gn.dynamics.UnseenParameterWarning")  # float16 rounds statistics
@torch.no_grad()
def test_it_follows_the_weights(quick, inputs, general_steps, change):
    predictor = quick()
    state, action = inputs(predictor, 3)
    before = [predictor.step(state, action)[0] for _ in range(2)]
    assert torch.equal(*before) and len(general_steps) == 1
    change(predictor.model)
    expected = specialize(predictor.model.bind(predictor.scene)).step(state, action)[0]
    assert torch.equal(predictor.step(state, action)[0], expected)
    assert torch.equal(predictor.step(state, action)[0], expected)
    assert not torch.equal(expected, before[0])


@torch.no_grad()
def test_it_sees_a_parameter_that_was_replaced(quick, inputs):
    predictor = quick()
    state, action = inputs(predictor, 3)
    before = [predictor.step(state, action)[0] for _ in range(2)][0]
    layer = next(each for each in predictor.model.modules() if isinstance(each, torch.nn.Linear))
    layer.weight = torch.nn.Parameter(2 * layer.weight, requires_grad=False)
    expected = specialize(predictor.model.bind(predictor.scene)).step(state, action)[0]
    assert torch.equal(predictor.step(state, action)[0], expected) and not torch.equal(expected, before)


def test_gradients_transforms_and_modes_take_the_general_way(quick, inputs):
    predictor = quick(dtype=torch.float64)
    state, action = inputs(predictor, 3)
    expected = [predictor.step(state, action)[0] for _ in range(2)][0]
    leaf = action.clone().requires_grad_()
    found = predictor.step(state, leaf)[0]
    assert found.requires_grad and torch.autograd.grad(found.sum(), leaf)[0].abs().sum() > 0
    with torch.no_grad():
        assert torch.equal(predictor.step(state, leaf)[0], expected)
    each = torch.vmap(lambda one, other: predictor.step(one, other)[0])(state, action)
    torch.testing.assert_close(each, expected, rtol=1e-9, atol=1e-12)
    tangent = torch.func.jvp(lambda one: predictor.step(state, one)[0], (action,), (torch.ones_like(action),))[1]
    assert tangent.abs().sum() > 0
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(action, torch.ones_like(action))
        found = forward_ad.unpack_dual(predictor.step(state, dual)[0]).tangent
        torch.testing.assert_close(found, tangent, rtol=1e-9, atol=1e-12)
    with FlopCounterMode(display=False) as counter:
        predictor.step(state, action)
    assert counter.get_total_flops() > 0


def test_inputs_of_another_kind_take_the_general_way(quick, inputs):
    predictor = quick()
    state, action = inputs(predictor, 4)
    expected = [predictor.step(state, action)[0] for _ in range(2)][0]
    apart = torch.stack((state, state), -1)[..., 0]
    assert not apart.is_contiguous() and torch.equal(predictor.step(apart, action)[0], expected)
    with pytest.raises(ValueError, match=r"State of scene 'swimmer6' must be"):
        predictor.step(state[:, 1:], action)
    for wrong in (action[:, 1:], action[:3], action[0], action.flatten()):
        with pytest.raises(ValueError, match=r"Action of scene 'swimmer6' must be"):
            predictor.step(state, wrong)
    assert predictor.step(state[:0], action[:0])[0].shape == state[:0].shape
    lifted = state.clone()
    lifted[:2, 1, 2] += 0.1  # out of the plane
    eager = specialize(predictor.model.bind(predictor.scene), executor="eager")
    torch.testing.assert_close(predictor.step(lifted, action)[0], eager.step(lifted, action)[0], rtol=1e-4, atol=1e-5)
    broken = state.clone()
    broken[0, 1, 0] = torch.nan
    found = predictor.step(broken, action)[0]
    assert found[0].isnan().any() and torch.equal(found[1:], expected[1:])


def test_copies_and_the_end_of_a_predictor(quick, inputs):
    predictor = quick()
    state, action = inputs(predictor, 3)
    expected = [predictor.step(state, action)[0] for _ in range(2)][0]
    twin = copy.deepcopy(predictor)
    with torch.no_grad():
        next(predictor.model.parameters()).mul_(1.5)
    for _ in range(2):
        assert torch.equal(twin.step(state, action)[0], expected)
    del predictor
    assert torch.equal(twin.step(state, action)[0], expected)


def test_inference_mode_and_refresh(quick, inputs):
    predictor = quick()
    state, action = inputs(predictor, 3)
    with torch.inference_mode():
        for _ in range(2):
            expected = predictor.step(state, action)[0]
    assert torch.equal(predictor.step(state, action)[0], expected)
    next(predictor.model.parameters()).data.mul_(2)
    assert torch.equal(predictor.step(state, action)[0], expected)
    predictor.refresh()
    assert not torch.equal(predictor.step(state, action)[0], expected)


def test_several_threads_step_while_weights_change(quick, inputs):
    predictor = quick()
    state, action = inputs(predictor, 5)
    weights = [next(predictor.model.parameters()).detach().clone() * scale for scale in (1, 2)]
    expected = []
    for weight in weights:
        with torch.no_grad():
            next(predictor.model.parameters()).copy_(weight)
        expected.append(predictor.step(state, action)[0])

    def work(_: int) -> bool:
        found = [predictor.step(state, action)[0] for _ in range(300)]
        return all(any(torch.equal(each, one) for one in expected) for each in found)

    with ThreadPoolExecutor(3) as pool:
        results = pool.map(work, range(3))
        for round_ in range(20):
            with torch.no_grad():
                next(predictor.model.parameters()).copy_(weights[round_ % 2])
        assert all(results)
    assert torch.equal(predictor.step(state, action)[0], expected[1])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (1,), (3,), (2, 3), (24,), (60,)])
def test_gradients_are_those_of_the_general_way(quick, inputs, general_steps, dtype, batch):
    predictor = quick(dtype=dtype)
    state, action = inputs(predictor, *batch)
    predictor.step(state, action)
    leaves = state.requires_grad_(), action.requires_grad_()
    gradient = torch.randn_like(state)
    expected = torch.autograd.grad(predictor.executor().step(*leaves)[0], leaves, gradient)
    general_steps.clear()
    found = torch.autograd.grad(predictor.step(*leaves)[0], leaves, gradient)
    assert all(map(torch.equal, found, expected))
    assert len(general_steps) == (batch == (60,))  # whose activations come from a pool
    only = torch.autograd.grad(predictor.step(state.detach(), action)[0].sum(), action)[0]  # an expanded gradient
    whole = torch.autograd.grad(predictor.executor().step(*leaves)[0], action, torch.ones_like(state))[0]
    assert torch.equal(only, whole)


def test_gradients_add_up_over_steps_and_threads(quick, inputs):
    predictor = quick(dtype=torch.float64)
    state, action = inputs(predictor, 3)
    predictor.step(state, action)

    def pull(step) -> torch.Tensor:
        leaf = action.clone().requires_grad_()
        after = state
        for _ in range(5):
            after = step(after, leaf)[0]
        after.square().sum().backward()
        assert leaf.grad is not None
        return leaf.grad

    expected = pull(predictor.executor().step)
    assert torch.equal(pull(predictor.step), expected)
    with ThreadPoolExecutor(3) as pool:
        assert all(torch.equal(each, expected) for each in pool.map(lambda _: pull(predictor.step), range(30)))


def test_what_gradients_refuse(quick, inputs):
    predictor = quick()
    state, action = inputs(predictor, 3)
    predictor.step(state, action)
    leaf = action.requires_grad_()
    after = predictor.step(state, leaf)[0]
    assert after.grad_fn is not None and "SpecializedStep" in after.grad_fn.name()
    after.sum().backward()
    with pytest.raises(RuntimeError, match="second time"):
        after.sum().backward()
    first = torch.autograd.grad(predictor.step(state, leaf)[0].square().sum(), leaf, create_graph=True)[0]
    with pytest.raises(RuntimeError, match="first order; use executor='eager'"):
        torch.autograd.grad(first.sum(), leaf)
    after, other = predictor.step(state, leaf)[0], state.clone()
    changed = predictor.step(other, leaf)[0]
    other.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        changed.sum().backward()
    with pytest.raises(RuntimeError, match="such gradient; use executor='eager'"):
        torch.autograd.grad(after, leaf, torch.ones(2, *after.shape, dtype=after.dtype), is_grads_batched=True)
    after = predictor.step(state, leaf)[0]
    with torch.no_grad():
        next(predictor.model.parameters()).mul_(1.5)
    predictor.step(state, leaf)
    with pytest.raises(RuntimeError, match="weights changed between a prediction and its gradient"):
        after.sum().backward()


def test_a_gradient_outlives_the_predictor(quick, inputs):
    predictor = quick()
    state, action = inputs(predictor, 3)
    predictor.step(state, action)
    leaf = action.requires_grad_()
    expected = torch.autograd.grad(predictor.step(state, leaf)[0].sum(), leaf)[0]
    after = predictor.step(state, leaf)[0]
    del predictor
    gc.collect()
    assert torch.equal(torch.autograd.grad(after.sum(), leaf)[0], expected)
