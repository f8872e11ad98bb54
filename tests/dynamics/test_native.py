"""The native executor: the same bits whatever runs beside, and what it leaves to torch."""

from __future__ import annotations

import copy
import gc
import multiprocessing
import pickle
import re
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import pytest
import torch
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from torchrl_gn.dynamics import BodyState, BoundPredictor, Contacts, Controls, ForwardModel, JointAxes, specialize
from torchrl_gn.dynamics.executors.native import executor as native_executor
from torchrl_gn.dynamics.executors.native.operators import load_operators
from torchrl_gn.dynamics.executors.native.preparation import around_preparation, preparation
from torchrl_gn.dynamics.executors.native.tape import Tape, assemble
from torchrl_gn.dynamics.features import Feature

from .. import zoo
from ..sizes import SMALL
from .native import ROOT, equal, run, vjp, with_compiler

pytestmark = with_compiler

FEW = ("swimmer6", "joints")
ZOO = sorted(path.stem for path in (ROOT / "tests/zoo").glob("*.xml"))


# Preparation


def test_whoever_budgets_time_hears_of_every_preparation_and_large_scenes_say_it(wide, capsys):
    predictor, heard = wide("pendulum"), []

    @contextmanager
    def hear():
        heard.append("begins")
        yield
        heard.append("ends")

    with around_preparation(hear):
        for _ in range(2):  # the second time it is there
            predictor.prepared_for_training()
            predictor.prepared(size=10_000)
    predictor.model.bind(predictor.scene).prepared_for_training()
    assert heard == ["begins", "ends"] * 2
    with preparation(29):
        pass
    assert capsys.readouterr().err == ""
    with preparation(70):
        pass
    assert "a step of 70 bodies for C++, once in this process: about 3 min" in capsys.readouterr().err


def test_preparation_runs_without_collection():
    with preparation(3):
        assert not gc.isenabled()
    assert gc.isenabled()
    gc.disable()
    try:
        with preparation(3):
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


# The same bits


@pytest.mark.filterwarnings("ignore::torchrl_gn.processor.SlowDtypeWarning")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
@pytest.mark.parametrize("name", FEW)
def test_a_sample_is_the_same_in_every_batch(quick, inputs, name, dtype):
    if dtype == torch.bfloat16 and not load_operators().has_bfloat16():
        pytest.skip("the processor multiplies no bfloat16")
    predictor = quick(name, torch.float64 if dtype == torch.float64 else torch.float32, products=dtype)
    for lifted in (slice(0), slice(None, None, 3)):  # samples whose constant channels are not the scene's
        state, actions = inputs(predictor, 61)
        state[lifted, :, 2] += 0.1
        whole = vjp(predictor, state, actions)
        for count in (1, 2, 3, 4, 5, 8, 9, 16, 17, 24, 25, 48, 60):
            for start in (0, 61 - count):
                part = slice(start, start + count)
                assert equal(vjp(predictor, state[part], actions[part]), [each[part] for each in whole]), count
        order = torch.randperm(61, generator=torch.Generator().manual_seed(0))
        assert equal(vjp(predictor, state[order], actions[order]), [each[order] for each in whole])
    assert predictor.reason is None


@pytest.mark.filterwarnings("ignore::torchrl_gn.processor.SlowDtypeWarning")
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("name", FEW)
def test_the_number_of_threads_does_not_matter(quick, inputs, name, dtype):
    if dtype == torch.bfloat16 and not load_operators().has_bfloat16():
        pytest.skip("the processor multiplies no bfloat16")
    predictor = quick(name, products=dtype)
    for count in (1, 2, 7, 50):
        state, actions = inputs(predictor, count)
        expected = vjp(predictor, state, actions)
        for threads in (2, 3, 8):
            torch.set_num_threads(threads)
            assert equal(vjp(predictor, state, actions), expected)
        torch.set_num_threads(1)


@pytest.mark.slow
@pytest.mark.parametrize("many", [False, True])
def test_long_calls_are_made_in_parts_with_the_same_numbers(wide, inputs, monkeypatch, many):
    """Also over several axes of a batch; gradients of actions and states come in parts, too."""
    predictor = specialize(wide("swimmer6"))
    state, actions = inputs(predictor, 30, 3)
    actions, executor = actions if many else actions[..., 0, :], predictor.executor
    call = predictor.rollout if many else predictor.step

    def found() -> list[torch.Tensor]:
        given = [each.clone().requires_grad_() for each in (state, actions)]
        out = call(*given)[0]
        return [out, *torch.autograd.grad((out * out.detach().cos()).sum(), given)]

    expected, parts, operator = found(), [], executor._operator
    monkeypatch.setattr(executor, "longest", 1)
    monkeypatch.setattr(executor, "_operator", lambda first, *more: parts.append(len(first)) or operator(first, *more))
    assert equal(found(), expected) and sum(parts) == 90 and len(parts) == -(-90 // (24 * torch.get_num_threads()))


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_long_rollouts_of_few_samples_are_made_in_parts_with_the_same_numbers(wide, inputs, monkeypatch, dtype):
    """States of single precision would be rounded between the parts, so these are made whole."""
    predictor = specialize(wide("swimmer6"))
    state, actions = (each.to(dtype) for each in inputs(predictor, 2, 3, steps=7))
    expected, executor, parts = predictor.rollout(state, actions)[0], predictor.executor, []
    operator = executor._operator
    monkeypatch.setattr(executor, "longest", 48)  # two steps of a tile
    monkeypatch.setattr(executor, "numbers", 1)  # for which these are many
    monkeypatch.setattr(executor, "_operator", lambda *given: parts.append(given[1].shape[1]) or operator(*given))
    assert torch.equal(predictor.rollout(state, actions)[0], expected)
    assert parts == ([2, 2, 2, 1] if dtype == torch.float64 else [7])


@pytest.mark.slow
def test_ctrl_c_ends_a_long_call_between_its_parts(wide, inputs, monkeypatch, ctrl_c):
    predictor, parts = specialize(wide("swimmer6")), []
    state, actions = inputs(predictor, 24 * torch.get_num_threads() * 5)
    executor = predictor.executor
    operator = ctrl_c(executor._operator, 2)
    monkeypatch.setattr(executor, "longest", 1)
    monkeypatch.setattr(executor, "_operator", lambda first, *more: parts.append(len(first)) or operator(first, *more))
    with pytest.raises(KeyboardInterrupt):
        predictor.rollout(state, actions)
    assert len(parts) == 2


@pytest.mark.slow
def test_threads_may_change_between_a_prediction_and_its_gradient(quick, inputs):
    predictor = quick()
    state, actions = inputs(predictor, 50)
    expected = vjp(predictor, state, actions)[2]
    leaf = actions.clone().requires_grad_()
    weights = torch.linspace(-1, 1, 4 * state[0].numel(), dtype=torch.float64).view(4, *state.shape[1:])
    for before, after in ((1, 3), (3, 1), (2, 8)):
        torch.set_num_threads(before)
        states = predictor.rollout(state, leaf)[0]
        torch.set_num_threads(after)
        assert torch.equal(torch.autograd.grad((states * weights).sum(), leaf)[0], expected)


def test_steps_are_those_of_a_rollout(quick, inputs):
    predictor = quick()
    state, actions = inputs(predictor, 5, steps=6)
    states = predictor.rollout(state, actions)[0]
    for step in range(6):
        state = predictor.step(state, actions[:, step])[0]
        assert torch.equal(state, states[:, step + 1])


SCRIPT = """
import sys, numpy, torch
from tests import zoo
from torchrl_gn.dynamics import ForwardModel, specialize
from torchrl_gn.dynamics.executors.native.operators import load_operators
from torchrl_gn.dynamics.executors.native.preparation import around_preparation, preparation
torch.set_num_threads(1)
found = []
for name in ("swimmer6", "joints"):
    for activation in ("relu", "silu", "gelu", "tanh"):
        for dtype in (torch.float32, torch.float64):
            scene = zoo.load(name)
            torch.manual_seed(0)
            model = ForwardModel.for_scene(scene, latent=20, hidden=(36,), activation=activation).to(dtype)
            for normalizer in model.modules():
                if hasattr(normalizer, "m2"):
                    ones = {key: torch.ones_like(value) for key, value in normalizer.state_dict().items()}
                    normalizer.load_state_dict(ones)
            predictor = specialize(model.requires_grad_(False).bind(scene))
            generator = torch.Generator().manual_seed(1)
            state = torch.zeros(9, scene.num_nodes, 13, dtype=torch.float64)
            state[..., 3] = 1
            state[..., 7:] = torch.randn(9, scene.num_nodes, 6, dtype=torch.float64, generator=generator)
            state[..., 7:] *= torch.as_tensor(scene.movable[:, 6:])
            actions = torch.randn(9, 4, scene.num_actions, dtype=torch.float64, generator=generator)
            state.requires_grad_(), actions.requires_grad_()
            states = predictor.rollout(state, actions)[0]
            assert predictor.reason is None, predictor.reason
            gradients = torch.autograd.grad(states[:, 1:].square().sum(), (state, actions))
            found += [each.detach().flatten() for each in (states, *gradients)]
numpy.save(sys.argv[1], torch.cat(found).numpy())
load_operators()
print(*torch.ops.loaded_libraries)
"""


@pytest.mark.slow
@pytest.mark.skipif(torch.backends.cpu.get_cpu_capability() != "AVX512", reason="the processor has no AVX-512")
def test_with_and_without_avx512_all_bits_are_the_same(tmp_path):
    names = [
        run(SCRIPT, tmp_path / f"{each}.npy", ATEN_CPU_CAPABILITY=each).stdout.split()[-1]
        for each in ("avx512", "avx2")
    ]
    assert names[0] != names[1]
    found = [np.load(tmp_path / f"{each}.npy") for each in ("avx512", "avx2")]
    assert np.isfinite(found[0]).all() and np.ptp(found[0]) > 0
    np.testing.assert_array_equal(*found)


# States that are not finite, or not where the scene's are


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("what", ["state", "constant", "all", "action"])
def test_a_sample_that_is_not_finite_harms_no_other(quick, inputs, what, value):
    predictor = quick()
    state, actions = inputs(predictor, 27)
    fine = vjp(predictor, state, actions)
    bad_state, bad_actions = state.clone(), actions.clone()
    channel = {"state": (3, 0), "constant": (3, 2), "all": (...,), "action": ()}[what]
    (bad_state[11][channel] if channel else bad_actions[11])[...] = value
    found = vjp(predictor, bad_state, bad_actions)
    others = torch.arange(27) != 11
    assert equal([each[others] for each in found], [each[others] for each in fine])
    assert not found[0][11, -1].isfinite().all()
    alone = predictor.rollout(bad_state[11:12], bad_actions[11:12])[0]
    assert torch.equal(alone.nan_to_num(7.0), found[0][11:12].nan_to_num(7.0))
    assert predictor.reason is None


def test_all_samples_not_finite(quick, inputs):
    predictor = quick()
    state, actions = inputs(predictor, 3)
    assert not predictor.rollout(state * float("nan"), actions)[0].isfinite().any()


ODD = {
    "zeros": lambda s: torch.zeros_like(s),
    "ones": lambda s: torch.ones_like(s),
    "noise": lambda s: torch.randn(s.shape, generator=torch.Generator().manual_seed(0), dtype=s.dtype),
    "1000 km away": lambda s: s + 1e6 * torch.eye(13, dtype=s.dtype)[0],
    "fast": lambda s: s + 1e3 * torch.eye(13, dtype=s.dtype)[8],
    "no orientation": lambda s: torch.cat((s[..., :3], 1e-20 * s[..., 3:7], s[..., 7:]), -1),
    "long quaternions": lambda s: torch.cat((s[..., :3], 1e20 * s[..., 3:7], s[..., 7:]), -1),
    "turned": lambda s: torch.cat((s[..., :3], -s[..., 3:7], s[..., 7:]), -1),
}


@pytest.mark.parametrize("kind", ODD)
def test_odd_states_are_predicted_as_by_torch(quick, inputs, kind):
    native, eager = (quick(dtype=torch.float64, executor=executor) for executor in ("native", "eager"))
    state, actions = inputs(native, 4)
    plain = native.rollout(state, actions)[0]
    odd = torch.cat((ODD[kind](state[:1]), state[1:]))
    found, wanted = (each.rollout(odd, actions)[0] for each in (native, eager))
    assert torch.equal(found[1:], plain[1:])
    assert torch.equal(found.isfinite(), wanted.isfinite())
    sizes = wanted[:1].abs().nan_to_num(0.0, 0.0, 0.0).amax(-1, keepdim=True)
    assert ((found - wanted)[:1].abs().nan_to_num(0.0, 0.0, 0.0) <= 1e-8 * (1 + sizes)).all()
    assert native.reason is None


def test_states_elsewhere_are_predicted_too(quick, inputs):
    predictor, eager = (quick(dtype=torch.float64, executor=executor) for executor in ("native", "eager"))
    state, actions = inputs(predictor, 5)
    lifted, tilted = state.clone(), state.clone()
    lifted[:, 1:, 2] += 0.1
    tilted[:, 1:, 3:7] = torch.nn.functional.normalize(state[:, 1:, 3:7] + torch.tensor([0, 0.1, 0.2, 0]), dim=-1)
    tilted[:, 1:, 10:12] = 0.3
    mixed = torch.stack((state, lifted, tilted), dim=1).flatten(0, 1)
    for each in (lifted, tilted, mixed, state + 0.01):
        found, wanted = (vjp(one, each, actions.repeat_interleave(len(each) // 5, 0)) for one in (predictor, eager))
        for a, b in zip(found, wanted, strict=True):
            if a.shape == each.shape:  # gradients in constant channels are those of copying
                varies = torch.as_tensor(predictor.scene.movable[:, [0, 1, 2, 3, 4, 5, 6, 6, 7, 8, 9, 10, 11]])
                varies[:, 3:7] = False
                a, b = a * varies, b * varies
            assert (a - b).norm() <= 1e-10 * b.norm()
    assert predictor.reason is None


def test_the_order_of_states_does_not_matter(quick, inputs):
    predictor = quick()
    state, actions = inputs(predictor, 4)
    lifted = state + torch.eye(13, dtype=torch.float64)[2]
    apart = [vjp(predictor, lifted, actions), vjp(predictor, state, actions)]
    together = [torch.cat(each) for each in zip(*apart, strict=True)]
    mixed, both = torch.cat((lifted, state)), torch.cat((actions, actions))
    for order in (torch.arange(8), torch.arange(8).flip(0), torch.tensor([0, 4, 1, 5, 2, 6, 3, 7])):
        assert equal(vjp(predictor, mixed[order], both[order]), [each[order] for each in together])


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
def test_state_maths_are_traced_when_it_is_made(wide, inputs, monkeypatch):
    bound = wide()
    predictor, eager = (specialize(bound, executor=executor) for executor in ("native", "eager"))
    monkeypatch.setattr(
        "torchrl_gn.dynamics.executors.native.executor.StateMaths", lambda *_: pytest.fail("traced again")
    )
    with torch.no_grad():
        for weight in bound.model.parameters():
            weight.mul_(1.1)
    state, actions = inputs(predictor, 3)
    for each in (predictor, eager):
        each.refresh(bound)
    for start in (state, state + 0.1):
        found, expected = (each.rollout(start, actions)[0] for each in (predictor, eager))
        torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6)


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


# Features of one's own


def with_feature(fit, scene, function, **options) -> BoundPredictor:
    """Bound predictor whose nodes also see ``function(state)``, ``[*B, N, 1]``."""

    class Bound(nn.Module):
        def forward(self, inputs):
            return function(inputs.canonical.state)

    @dataclass(frozen=True)
    class Own(Feature):
        part: ClassVar[Literal["nodes", "edges"]] = "nodes"

        def size(self, layout):
            return 1

        def bind(self, scene, layout, canonicalizer):
            return Bound()

    torch.manual_seed(0)
    model = ForwardModel.for_scene(scene, features=(BodyState(), Controls(), Own()), **SMALL, **options)
    return fit(model, scene).double().bind(scene)


SKEW = torch.tensor([[2.0, 1, 0], [-1, 2, 1], [0.5, 0, 1]], dtype=torch.float64)
REASONS = {
    "erf": (lambda s: s[..., 7:8].erf(), "erf"),
    "branch": (lambda s: s[..., 7:8] if (s[..., 7] > 0).any() else s[..., 8:9], "has no scalar form"),
    "item": (lambda s: s[..., 7:8] * s.sum().item(), "_local_scalar_dense"),
    "list": (lambda s: s[..., 7:8] * np.sum(s.tolist()), "tolist"),
    "unsymmetric": (
        lambda s: torch.linalg.solve(SKEW, s[..., 7:10, None])[..., :1, 0],
        "native step differs from torch's by .* of the change",
    ),
    "symmetric": (lambda s: torch.linalg.solve(SKEW @ SKEW.T, s[..., 7:10, None])[..., :1, 0], None),
    "norm": (lambda s: s[..., 7:10].norm(dim=-1, keepdim=True), None),
    "largest": (lambda s: s[..., 7:10].abs().amax(-1, keepdim=True), None),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", REASONS)
def test_features_of_ones_own(fit, inputs, kind):
    function, reason = REASONS[kind]
    bound = with_feature(fit, zoo.load("arm"), function)
    predictor, eager = (specialize(bound, executor=executor) for executor in ("native", "eager"))
    state, actions = inputs(predictor, 4)
    found, expected = predictor.rollout(state, actions)[0], eager.rollout(state, actions)[0]
    if reason is None:
        assert predictor.reason is None
        assert (found - expected).norm() <= 1e-12 * expected.norm()
        return
    assert torch.equal(found, expected)
    given = predictor.reason
    assert given is not None and re.search(reason, given) and "\n" not in given
    assert f"native, but here by torch: {given}" in str(predictor)
    predictor.refresh(bound)
    assert torch.equal(predictor.rollout(state, actions)[0], expected) and predictor.reason == given


@pytest.mark.slow
def test_state_maths_with_too_many_registers(wide, quick, inputs, monkeypatch):
    eager, registers = quick(executor="eager"), []
    state, actions = inputs(eager, 3)
    lifted = state + torch.eye(13, dtype=torch.float64)[2]

    def counted(*arguments) -> Tape:
        registers.append(assemble(*arguments).registers)
        return assemble(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr("torchrl_gn.dynamics.executors.native.state_maths.assemble", counted)
        specialize(wide())
    assert len(registers) == 4  # two state maths and their gradients
    most = "torchrl_gn.dynamics.executors.native.tape._MOST_REGISTERS"
    monkeypatch.setattr(most, max(registers[:2]))  # enough for the scene's states, not for others
    predictor = specialize(wide())
    assert predictor.reason is None and max(registers[2:]) > max(registers[:2])
    assert equal(vjp(predictor, state, actions), vjp(quick(), state, actions))
    mixed, both = torch.cat((lifted, state)), torch.cat((actions, actions))
    for start, given in ((lifted, actions), (mixed, both)):
        for found, expected in zip(vjp(predictor, start, given), vjp(eager, start, given), strict=True):
            torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
    monkeypatch.setattr(most, 50)
    predictor = specialize(wide())
    assert equal(vjp(predictor, state, actions), vjp(eager, state, actions))  # without packed weights
    assert re.search(r"needs \d+ registers", predictor.reason)


# Scenes


def zoo_cases() -> list:
    few = ("arm", "everything", "odd", "soft", "tumbler", "parallel_hinges", "quadrotor", "machine")
    return [pytest.param(name, marks=[] if name in few else pytest.mark.slow) for name in ZOO]


@pytest.mark.slow
@pytest.mark.parametrize("name", zoo_cases())
def test_every_scene_is_traced(make_model, moved, random_states, random_actions, name):
    scene = zoo.load(name)
    axes = () if scene.state_size != 13 else (JointAxes().resolved(scene), Contacts())
    for options in ({}, {"features": (BodyState(encoding="quaternion"), Controls(), *axes), "integrate": False}):
        if options and not axes:
            continue
        bound = make_model(scene, **options).double().requires_grad_(False).bind(scene)
        predictor, eager = (specialize(bound, executor=executor) for executor in ("native", "eager"))
        state = torch.cat((moved(bound, 3), random_states(scene, 2, seed=3)))  # for both state maths
        actions = random_actions(scene, 5, 2, seed=3)
        some = random_states(scene, 20)
        varies = (some != some[0]).any(0)
        expected, found = (vjp(each, state, actions) for each in (eager, predictor))
        assert predictor.reason is None
        for index, (wanted, got) in enumerate(zip(expected, found, strict=True)):
            wanted, got = (each * varies if index == 1 else each for each in (wanted, got))
            assert (got - wanted).norm() <= 1e-10 * wanted.norm()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["humanoid", "walker", "hopper", "swimmer"])
def test_scenes_of_the_suite_are_traced(make_model, moved, random_states, random_actions, name):
    suite = pytest.importorskip("dm_control.suite")
    from torchrl_gn.scenes import load_scene

    scene = load_scene(Path(suite.__file__).with_name(f"{name}.xml")) if name != "swimmer" else load_scene("swimmer15")
    bound = make_model(scene).double().bind(scene)
    predictor, eager = (specialize(bound, executor=executor) for executor in ("native", "eager"))
    state, action = torch.cat((moved(bound, 2), random_states(scene, 2))), random_actions(scene, 4, seed=3)
    found, expected = predictor.step(state, action)[0], eager.step(state, action)[0]
    assert predictor.reason is None
    assert (found - expected).norm() <= 1e-10 * (expected - state).norm()


@pytest.mark.slow
@pytest.mark.parametrize(("large", "maths"), [(1, 1), (10**9, 2)])
def test_large_scenes_are_traced_once_for_all_states(
    make_model, moved, random_states, random_actions, monkeypatch, large, maths
):
    """Of a free body in space only the world's pose is constant: one state maths is hardly longer than the other."""
    from torchrl_gn.scenes import load_scene

    monkeypatch.setattr(native_executor, "LARGE", large)
    link = '<geom size=".1"/><body pos=".3 0 0"><joint name="j" axis="0 1 0"/><geom size=".1"/></body>'
    tree, motor = f'<body pos="0 0 1"><freejoint/>{link}</body>', '<motor joint="j" ctrlrange="-1 1"/>'
    scene = load_scene(f"<mujoco><worldbody>{tree}</worldbody><actuator>{motor}</actuator></mujoco>")
    bound = make_model(scene).double().bind(scene)
    predictor, eager = (specialize(bound, executor=executor) for executor in ("native", "eager"))
    executor = native_executor.NativeExecutor(bound.program())
    assert sum(place >= 0 for place in executor.structure[5:7].tolist()) == maths
    state, action = torch.cat((moved(bound, 2), random_states(scene, 2))), random_actions(scene, 4, seed=3)
    found, expected = predictor.step(state, action)[0], eager.step(state, action)[0]
    assert predictor.reason is None
    assert (found - expected).norm() <= 1e-10 * (expected - state).norm()


@pytest.mark.parametrize("large", [1, 10**9])
def test_planar_state_maths_is_traced_apart(make_model, monkeypatch, large):
    from torchrl_gn.scenes import load_scene

    monkeypatch.setattr(native_executor, "LARGE", large)
    scene = load_scene("swimmer3")
    executor = native_executor.NativeExecutor(make_model(scene).bind(scene).program())
    assert (executor.structure[5:7] >= 0).all()


@pytest.mark.parametrize("name", FEW)
def test_at_rest_gradients_are_finite(quick, name):
    """Square roots and angles at zero, as in a scene's first state."""
    predictor, eager = (quick(name, torch.float64, executor=executor) for executor in ("native", "eager"))
    state = torch.zeros(2, predictor.scene.num_nodes, 13, dtype=torch.float64)
    state[..., 3] = 1
    actions = torch.zeros(2, 2, predictor.scene.num_actions, dtype=torch.float64)
    found, expected = (vjp(each, state, actions) for each in (predictor, eager))
    torch.testing.assert_close(found[0], expected[0], rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(found[2], expected[2], rtol=1e-9, atol=1e-12)
    assert found[1].isfinite().all()
    assert predictor.reason is None
