"""Calls of the native executor: shapes and dtypes, fallbacks to torch, threads and processes."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from torchrl_gn.dynamics import specialize
from torchrl_gn.dynamics.executors.native import executor

from .native import equal, vjp, with_compiler

pytestmark = with_compiler


# Shapes, dtypes, gradients


@pytest.mark.parametrize("state_dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("action_dtype", [torch.float32, torch.float64])
def test_dtypes_go_together(quick, inputs, state_dtype, action_dtype):
    predictor, eager = (quick(dtype=torch.float64, executor=executor) for executor in ("native", "eager"))
    state, actions = inputs(predictor, 3)
    found = vjp(predictor, state.to(state_dtype), actions.to(action_dtype))
    expected = vjp(eager, state.to(state_dtype).double(), actions.to(action_dtype).double())
    assert [each.dtype for each in found] == [state_dtype, state_dtype, action_dtype]
    for a, b in zip(found[::2], expected[::2], strict=True):
        assert (a - b).norm() <= 1e-6 * b.norm()
    assert predictor.reason is None


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.int64])
def test_actions_of_other_dtypes_are_taken_by_torch(quick, inputs, dtype):
    native, eager = (quick(executor=executor) for executor in ("native", "eager"))
    state, actions = inputs(native, 3)
    found, expected = (each.rollout(state, (3 * actions).to(dtype))[0] for each in (native, eager))
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6)


def test_strides_and_batches(quick, inputs):
    predictor = quick()
    state, actions = inputs(predictor, 2, 1, 3, 2)
    found = vjp(predictor, state, actions)
    flat = vjp(predictor, state.flatten(0, 3), actions.flatten(0, 3))
    assert torch.equal(found[0], flat[0].view_as(found[0]))
    strided = state.transpose(0, 3).contiguous().transpose(0, 3), actions.mT.contiguous().mT
    assert not strided[0].is_contiguous() and torch.equal(predictor.rollout(*strided)[0], found[0])
    once = state[0, 0, 0, :1].expand(4, -1, -1), actions[0, 0, 0, :1].expand(4, -1, -1)
    leaves = [each.clone().requires_grad_() for each in (state[0, 0, 0, :1], actions[0, 0, 0, :1])]
    states = predictor.rollout(*(each.expand(4, -1, -1) for each in leaves))[0]
    assert equal(states, predictor.rollout(*once)[0])
    states[:, -1].sum().backward()
    assert all(leaf.grad is not None and leaf.grad.isfinite().all() for leaf in leaves)
    one = predictor.rollout(state[0, 0, 0, 0], actions[0, 0, 0, 0])[0]
    assert torch.equal(one, found[0][0, 0, 0, 0])


def test_nothing_to_predict(quick, inputs):
    predictor = quick()
    state, actions = inputs(predictor, 4)
    for batch in ((0,), (2, 0, 3)):
        empty = (
            state.new_zeros((*batch, *state.shape[1:])).requires_grad_(),
            actions.new_zeros((*batch, *actions.shape[1:])),
        )
        states = predictor.rollout(*empty)[0]
        assert states.shape == (*batch, 4, *state.shape[1:])
        assert predictor.step(empty[0], empty[1][..., 0, :])[0].shape == empty[0].shape
        states.sum().backward()
    assert torch.equal(predictor.rollout(state, actions[:, :0])[0], state.unsqueeze(1))
    falling = quick("falling")
    state, actions = inputs(falling, 4)
    assert actions.shape[-1] == 0 and falling.rollout(state, actions)[0].shape == (4, 4, *state.shape[1:])
    assert falling.reason is None


def test_wrong_shapes_are_named(quick):
    predictor = quick("pendulum")
    for state, action in (
        ((5, 3, 13), (5, 1)),
        ((5, 2, 12), (5, 1)),
        ((13,), (1,)),
        ((5, 2, 13), (4, 1)),
        ((5, 2, 13), (5, 2)),
        ((5, 2, 13), (1,)),
        ((5, 2, 13), (5,)),
    ):
        with pytest.raises(ValueError, match="of scene 'pendulum' must be"):
            predictor.step(torch.zeros(state), torch.zeros(action))
        with pytest.raises(ValueError, match="of scene 'pendulum' must be"):
            predictor.rollout(torch.zeros(state), torch.zeros(action).unsqueeze(-2))


def test_gradients_are_asked_for_one_by_one(quick, inputs):
    predictor = quick()
    state, actions = inputs(predictor, 3)
    expected = vjp(predictor, state, actions)
    weights = torch.linspace(-1, 1, expected[0][0].numel(), dtype=torch.float64).view(expected[0].shape[1:])
    for index in (0, 1):
        leaves = [state.clone(), actions.clone()]
        leaf = leaves[index].requires_grad_()
        states = predictor.rollout(*leaves)[0]
        assert torch.equal(torch.autograd.grad((states * weights).sum(), leaf)[0], expected[1 + index])
    with torch.no_grad():
        assert not predictor.rollout(leaf.new_tensor(state.tolist()).requires_grad_(), actions)[0].requires_grad


@pytest.mark.slow
def test_inference_mode(quick, wide, inputs):
    state, actions = inputs(quick(), 3)
    with torch.inference_mode():
        predictor = specialize(wide())  # made within, used outside
        found = predictor.rollout(state.clone(), actions.clone())[0]
        assert found.is_inference()
    assert equal(vjp(predictor, state, actions), vjp(quick(), state, actions))
    assert torch.equal(found.clone(), vjp(predictor, state, actions)[0])
    with torch.inference_mode():
        predictor.refresh(wide())
    assert equal(vjp(predictor, state, actions), vjp(quick(), state, actions))


@pytest.mark.slow
@pytest.mark.parametrize("device", ["meta"])
def test_another_default_device(quick, wide, inputs, device):
    state, actions = inputs(quick(), 3)
    expected = vjp(quick(), state, actions)
    leaves, bound = (state.clone().requires_grad_(), actions.clone().requires_grad_()), wide()
    weights = torch.linspace(-1, 1, expected[0][0].numel(), dtype=torch.float64).view(expected[0].shape[1:])
    with torch.device(device):
        predictor = specialize(bound)
        states = predictor.rollout(*leaves)[0]
        found = torch.autograd.grad((states * weights).sum(), leaves)
        predictor.refresh(bound)
    assert equal([states, *found], expected)
    assert equal(vjp(predictor, state, actions), expected)


@pytest.mark.slow
def test_a_refresh_between_a_prediction_and_its_gradient(wide, inputs):
    bound = wide()
    predictor = specialize(bound)
    state, actions = inputs(predictor, 3)
    leaf = actions.requires_grad_()
    for predict in (lambda: predictor.step(state, leaf[:, 0])[0], lambda: predictor.rollout(state, leaf)[0]):
        after = predict()
        predictor.refresh(bound)
        with pytest.raises(RuntimeError, match="modified by an inplace operation"):
            after.sum().backward()


@pytest.mark.slow
def test_state_maths_are_traced_when_it_is_made(wide, inputs, calls):
    bound = wide()
    traced = calls(executor, "StateMaths")
    predictor, eager = (specialize(bound, executor=name) for name in ("native", "eager"))
    count = len(traced)
    with torch.no_grad():
        for weight in bound.model.parameters():
            weight.mul_(1.1)
    state, actions = inputs(predictor, 3)
    for each in (predictor, eager):
        each.refresh(bound)
    for start in (state, state + 0.1):
        found, expected = (each.rollout(start, actions)[0] for each in (predictor, eager))
        torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6)
    assert len(traced) == count > 0


# What torch must see


def test_transforms_see_every_operation(quick, inputs):
    predictor = quick(dtype=torch.float64)
    state, actions = inputs(predictor, 3)
    action = actions[:, 0]
    predictor.step(state, action)

    def step(state, action):
        return predictor.step(state, action)[0]

    expected = step(state, action)
    torch.testing.assert_close(torch.vmap(step)(state, action), expected)
    out, pull_back = torch.func.vjp(step, state, action)
    torch.testing.assert_close(out, expected)
    leaves = state.clone().requires_grad_(), action.clone().requires_grad_()
    gradients = torch.autograd.grad(step(*leaves).square().sum(), leaves)
    torch.testing.assert_close(pull_back(2 * out)[1], gradients[1])
    reverse = torch.func.jacrev(step, argnums=1)(state[0], action[0])
    forward = torch.func.jacfwd(step, argnums=1)(state[0], action[0])
    torch.testing.assert_close(forward, reverse)
    _, tangent = torch.func.jvp(lambda action: step(state, action), (action,), (torch.ones_like(action),))
    with torch.autograd.forward_ad.dual_level():
        dual = step(state, torch.autograd.forward_ad.make_dual(action, torch.ones_like(action)))
        torch.testing.assert_close(torch.autograd.forward_ad.unpack_dual(dual).tangent, tangent)
    assert predictor.reason is None


def test_modes_and_tensor_subclasses_see_every_operation(quick, inputs):
    predictor = quick()
    state, actions = inputs(predictor, 3)
    expected = predictor.step(state, actions[:, 0])[0]

    class Count(TorchDispatchMode):
        count = 0

        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            self.count += 1
            return func(*args, **(kwargs or {}))

    with Count() as mode:
        torch.testing.assert_close(predictor.step(state, actions[:, 0])[0], expected)
    assert mode.count > 20
    with FlopCounterMode(display=False) as counter:
        predictor.step(state, actions[:, 0])
    assert counter.get_total_flops() > 0

    class Own(torch.Tensor):
        pass

    assert type(predictor.step(state.as_subclass(Own), actions[:, 0])[0]) is Own


# Threads and processes


@pytest.mark.parametrize("shared", [True, False])
def test_python_threads_step_at_once(quick, inputs, shared):
    predictor = quick()
    predictors = [predictor if shared else copy.deepcopy(predictor) for _ in range(4)]
    data = [inputs(predictor, count, seed=count) for count in (1, 7, 30, 50)]
    data[1][0][..., 2] += 0.1  # other state maths
    data[2][0][::2, :, 2] += 0.1  # both
    expected = [vjp(predictor, *each) for each in data]
    start = threading.Barrier(4)

    def work(index: int) -> bool:
        torch.set_num_threads(1 + index % 2)
        start.wait()
        return all(equal(vjp(predictors[index], *data[index]), expected[index]) for _ in range(10))

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(work, range(4)))


@pytest.mark.slow
def test_a_refresh_while_another_thread_steps(wide, inputs):
    bound = wide(latent=64)
    predictor = specialize(bound)
    state, actions = inputs(predictor, 30)
    done = threading.Event()

    def work() -> bool:
        finite = True
        while not done.is_set():
            finite = finite and bool(predictor.rollout(state, actions)[0].isfinite().all())
        return finite

    with ThreadPoolExecutor(1) as pool:
        finite = pool.submit(work)
        for _ in range(10):
            with torch.no_grad():
                for weight in bound.model.parameters():
                    weight.mul_(0.99)
            predictor.refresh(bound)
        done.set()
        assert finite.result()
    assert torch.equal(predictor.rollout(state, actions)[0], specialize(bound).rollout(state, actions)[0])


def _in_child(queue, predictor, state, actions) -> None:
    torch.set_num_threads(3)
    queue.put(predictor.rollout(state, actions)[0].numpy())


@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_other_processes_predict_the_same(quick, inputs, method):
    predictor = quick()
    state, actions = inputs(predictor, 60)
    torch.set_num_threads(3)
    expected = predictor.rollout(state, actions)[0]
    torch.set_num_threads(1)
    context = multiprocessing.get_context(method)
    queue = context.Queue()
    process = context.Process(target=_in_child, args=(queue, predictor, state, actions))
    process.start()
    found = queue.get(timeout=300)
    process.join()
    np.testing.assert_array_equal(found, expected.numpy())
    assert process.exitcode == 0


def test_copies_predict_the_same(quick, inputs):
    predictor = quick()
    state, actions = inputs(predictor, 3)
    expected = vjp(predictor, state, actions)
    for copied in (copy.deepcopy(predictor), pickle.loads(pickle.dumps(predictor))):
        assert equal(vjp(copied, state, actions), expected)
        assert copied.executor is not predictor.executor and copied.reason is None
