"""The native executor: the same bits whatever runs beside, what it leaves to torch, and how its code is built."""

from __future__ import annotations

import copy
import ctypes
import hashlib
import multiprocessing
import os
import pickle
import re
import shutil
import subprocess
import sys
import textwrap
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import pytest
import torch
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl_gn.dynamics.executors.native.binding import load_binding
from torchrl_gn.dynamics.executors.native.pool import Pool

from torchrl_gn.dynamics import BodyState, Contacts, Controls, ForwardModel, JointAxes, SpecializedPredictor, specialize
from torchrl_gn.dynamics.executors import NativeExecutor
from torchrl_gn.dynamics.executors.native import build, library
from torchrl_gn.dynamics.executors.native import executor as native_executor
from torchrl_gn.dynamics.features import Feature

from .. import zoo
from ..compiling import compiles
from ..sizes import SMALL

ROOT = Path(__file__).parents[2]
FEW = ("swimmer6", "joints")
ZOO = sorted(path.stem for path in (ROOT / "tests/zoo").glob("*.xml"))


def _has_compiler() -> bool:
    try:
        library.load_library()
    except build.NoCompilerError:
        return False
    return True


pytestmark = pytest.mark.skipif(not _has_compiler(), reason="there is no C++ compiler")


def native(predictor) -> NativeExecutor:
    executor = predictor.executor()
    assert isinstance(executor, NativeExecutor)
    return executor


@pytest.fixture
def quick(scenes, make_model):
    """Specialised predictor of a system, its network wide enough for whole vectors and rests of them."""

    def make(name: str = "swimmer6", dtype=torch.float32, products=None, **options) -> SpecializedPredictor:
        options = {"latent": 20, "edge_hidden": (36,), "node_hidden": (36,), "activation": "silu"} | options
        model = make_model(scenes[name], **options).to(dtype).requires_grad_(False)
        return specialize(model.bind(scenes[name]), dtype=products)

    return make


@pytest.fixture
def inputs(random_states, random_actions):
    """States ``[*batch, N, 13]`` and actions ``[*batch, steps, A]`` of a predictor's scene."""

    def draw(predictor, *batch: int, steps: int = 3, seed: int = 3):
        scene = predictor.scene
        return random_states(scene, *batch, seed=seed, scale=0.3), random_actions(scene, *batch, steps, seed=seed)

    return draw


def pull(predictor, state, actions):
    """States of a rollout, and gradients of a function of them."""
    leaves = [each.detach().clone().requires_grad_() for each in (state, actions)]
    states = predictor.rollout(*leaves)[0]
    weights = torch.linspace(-1, 1, states[0].numel(), dtype=states.dtype).view(states.shape[1:])
    return [states.detach(), *torch.autograd.grad((states * weights).sum(), leaves)]


def equal(found, expected) -> bool:
    return all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


# The same bits


@pytest.mark.filterwarnings("ignore::torchrl_gn.processor.SlowDtypeWarning")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
@pytest.mark.parametrize("name", FEW)
def test_a_sample_is_the_same_in_every_batch(quick, inputs, name, dtype):
    if dtype == torch.bfloat16 and not library.load_library().gn_has_bfloat16():
        pytest.skip("the processor multiplies no bfloat16")
    predictor = quick(name, torch.float64 if dtype == torch.float64 else torch.float32, products=dtype)
    state, actions = inputs(predictor, 61)
    whole = pull(predictor, state, actions)
    for count in (1, 2, 3, 4, 5, 8, 9, 16, 17, 24, 25, 48, 60):
        for start in (0, 61 - count):
            part = slice(start, start + count)
            assert equal(pull(predictor, state[part], actions[part]), [each[part] for each in whole]), (count, start)
    order = torch.randperm(61, generator=torch.Generator().manual_seed(0))
    assert equal(pull(predictor, state[order], actions[order]), [each[order] for each in whole])
    assert native(predictor).reason is None


@pytest.mark.filterwarnings("ignore::torchrl_gn.processor.SlowDtypeWarning")
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("name", FEW)
def test_the_number_of_threads_does_not_matter(quick, inputs, name, dtype):
    if dtype == torch.bfloat16 and not library.load_library().gn_has_bfloat16():
        pytest.skip("the processor multiplies no bfloat16")
    predictor = quick(name, products=dtype)
    for count in (1, 2, 7, 50):
        state, actions = inputs(predictor, count)
        expected = pull(predictor, state, actions)
        for threads in (2, 3, 8):
            torch.set_num_threads(threads)
            assert equal(pull(predictor, state, actions), expected)
        torch.set_num_threads(1)


def test_steps_are_those_of_a_rollout(quick, inputs):
    predictor = quick()
    state, actions = inputs(predictor, 5, steps=6)
    states = predictor.rollout(state, actions)[0]
    for step in range(6):
        state = predictor.step(state, actions[:, step])[0]
        assert torch.equal(state, states[:, step + 1])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("activation", ["relu", "silu", "gelu", "tanh"])
def test_steps_that_are_computed_again_give_the_same_gradient(quick, inputs, monkeypatch, dtype, activation):
    predictor = quick("joints", dtype, activation=activation)
    for count in (1, 26):
        state, actions = inputs(predictor, count)
        kept = pull(predictor, state, actions)
        with monkeypatch.context() as patch:
            patch.setattr(native_executor, "STORED_BYTES", 0)
            assert equal(pull(predictor, state, actions), kept)


SCRIPT = """
import sys, numpy, torch
from tests import zoo
from torchrl_gn.dynamics import ForwardModel, specialize
from torchrl_gn.dynamics.executors.native import library
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
            assert predictor.executor().reason is None, predictor.executor().reason
            gradients = torch.autograd.grad(states[:, 1:].square().sum(), (state, actions))
            found += [each.detach().flatten() for each in (states, *gradients)]
numpy.save(sys.argv[1], torch.cat(found).numpy())
print(library.load_library()._name)
"""


def run(code: str, *arguments, check: bool = True, **variables) -> subprocess.CompletedProcess:
    """Run Python code in another process."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", **variables}
    command = [sys.executable, "-c", textwrap.dedent(code), *map(str, arguments)]
    return subprocess.run(command, check=check, capture_output=True, text=True, cwd=ROOT, env=environment)


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
    for first in (False, True):  # whether the executor has seen other states before
        predictor = quick()
        state, actions = inputs(predictor, 27)
        fine = pull(quick(), state, actions)
        if not first:
            predictor.rollout(state, actions)
        bad_state, bad_actions = state.clone(), actions.clone()
        channel = {"state": (3, 0), "constant": (3, 2), "all": (...,), "action": ()}[what]
        (bad_state[11][channel] if channel else bad_actions[11])[...] = value
        found = pull(predictor, bad_state, bad_actions)
        others = torch.arange(27) != 11
        assert equal([each[others] for each in found], [each[others] for each in fine])
        assert not found[0][11, -1].isfinite().all()
        alone = predictor.rollout(bad_state[11:12], bad_actions[11:12])[0]
        assert torch.equal(alone.nan_to_num(7.0), found[0][11:12].nan_to_num(7.0))
        assert equal(pull(predictor, state, actions), fine)
        assert native(predictor).reason is None


def test_all_samples_not_finite(quick, inputs):
    predictor = quick()
    state, actions = inputs(predictor, 3)
    assert not predictor.rollout(state * float("nan"), actions)[0].isfinite().any()
    assert torch.equal(predictor.rollout(state, actions)[0], quick().rollout(state, actions)[0])
    assert native(predictor).reason is None


def test_states_elsewhere_are_predicted_too(quick, inputs, scenes):
    predictor = quick(dtype=torch.float64)
    eager = specialize(predictor, executor="eager")
    state, actions = inputs(predictor, 5)
    lifted, tilted = state.clone(), state.clone()
    lifted[:, 1:, 2] += 0.1
    tilted[:, 1:, 3:7] = torch.nn.functional.normalize(state[:, 1:, 3:7] + torch.tensor([0, 0.1, 0.2, 0]), dim=-1)
    tilted[:, 1:, 10:12] = 0.3
    mixed = torch.stack((state, lifted, tilted), dim=1).flatten(0, 1)
    expected = pull(predictor, state, actions)
    for each in (lifted, tilted, state, mixed, state + 0.01, lifted):
        found, wanted = (pull(one, each, actions.repeat_interleave(len(each) // 5, 0)) for one in (predictor, eager))
        for a, b in zip(found, wanted, strict=True):
            if a.shape == each.shape:  # gradients in constant channels are those of copying
                varies = torch.as_tensor(predictor.scene.movable[:, [0, 1, 2, 3, 4, 5, 6, 6, 7, 8, 9, 10, 11]])
                varies[:, 3:7] = False
                a, b = a * varies, b * varies
            assert (a - b).norm() <= 1e-10 * b.norm()
        assert equal(pull(predictor, state, actions), expected)
    assert native(predictor).reason is None


def test_the_order_of_states_met_does_not_matter(quick, inputs):
    first, second = quick(), quick()
    state, actions = inputs(first, 4)
    lifted = state + torch.eye(13, dtype=torch.float64)[2]
    mixed, both = torch.cat((lifted, state)), torch.cat((actions, actions))
    found = [pull(first, state, actions), pull(first, lifted, actions)]
    assert equal(pull(second, mixed, both), [torch.cat(each) for each in zip(*reversed(found), strict=True)])


# Shapes, dtypes, gradients


@pytest.mark.parametrize("state_dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("action_dtype", [torch.float32, torch.float64])
def test_dtypes_go_together(quick, inputs, state_dtype, action_dtype):
    predictor = quick(dtype=torch.float64)
    state, actions = inputs(predictor, 3)
    found = pull(predictor, state.to(state_dtype), actions.to(action_dtype))
    expected = pull(
        specialize(predictor, executor="eager"), state.to(state_dtype).double(), actions.to(action_dtype).double()
    )
    assert [each.dtype for each in found] == [state_dtype, state_dtype, action_dtype]
    for a, b in zip(found[::2], expected[::2], strict=True):
        assert (a - b).norm() <= 1e-6 * b.norm()
    assert native(predictor).reason is None


def test_strides_and_batches(quick, inputs):
    predictor = quick()
    state, actions = inputs(predictor, 2, 1, 3, 2)
    found = pull(predictor, state, actions)
    flat = pull(predictor, state.flatten(0, 3), actions.flatten(0, 3))
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
    assert native(falling).reason is None


def test_wrong_shapes_never_reach_native_code(quick, monkeypatch):
    predictor = quick("pendulum")
    monkeypatch.setattr(library, "rollout", lambda *_: pytest.fail("ran"))
    for state, action in (
        ((5, 3, 13), (5, 1)),
        ((5, 2, 12), (5, 1)),
        ((13,), (1,)),
        ((5, 2, 13), (4, 1)),
        ((5, 2, 13), (5, 2)),
    ):
        with pytest.raises(ValueError, match="of scene 'pendulum' must be"):
            predictor.step(torch.zeros(state), torch.zeros(action))
        with pytest.raises(ValueError, match="of scene 'pendulum' must be"):
            predictor.rollout(torch.zeros(state), torch.zeros(action).unsqueeze(-2))


def test_gradients_are_asked_for_one_by_one(quick, inputs):
    predictor = quick()
    state, actions = inputs(predictor, 3)
    expected = pull(predictor, state, actions)
    weights = torch.linspace(-1, 1, expected[0][0].numel(), dtype=torch.float64).view(expected[0].shape[1:])
    for index in (0, 1):
        leaves = [state.clone(), actions.clone()]
        leaf = leaves[index].requires_grad_()
        states = predictor.rollout(*leaves)[0]
        assert torch.equal(torch.autograd.grad((states * weights).sum(), leaf)[0], expected[1 + index])
    with torch.no_grad():
        assert not predictor.rollout(leaf.new_tensor(state.tolist()).requires_grad_(), actions)[0].requires_grad
    leaf = state.clone().requires_grad_()
    (first,) = torch.autograd.grad(predictor.step(leaf, actions[:, 0])[0].square().sum(), leaf, create_graph=True)
    with pytest.raises(RuntimeError, match="differentiate twice.*once_differentiable"):
        first.sum().backward()


def test_inference_mode(quick, inputs):
    predictor = quick()
    with torch.inference_mode():  # traced and folded within, used outside
        state, actions = inputs(predictor, 3)
        found = predictor.rollout(state, actions)[0]
        assert found.is_inference()
    state, actions = inputs(predictor, 3)
    assert equal(pull(predictor, state, actions)[0], found)
    assert native(predictor).reason is None


@pytest.mark.parametrize("device", ["meta"])
def test_another_default_device(quick, inputs, device):
    predictor = quick()
    state, actions = inputs(predictor, 3)
    expected = pull(quick(), state, actions)
    leaves = state.clone().requires_grad_(), actions.clone().requires_grad_()
    weights = torch.linspace(-1, 1, expected[0][0].numel(), dtype=torch.float64).view(expected[0].shape[1:])
    with torch.device(device):
        states = predictor.rollout(*leaves)[0]
        found = torch.autograd.grad((states * weights).sum(), leaves)
    assert equal([states, *found], expected)


@pytest.mark.parametrize("options", [{}, {"latent": 24}])
def test_weights_that_change_between_a_prediction_and_its_gradient(quick, inputs, options):
    predictor = quick(**options)
    state, action = inputs(predictor, 3)[0].requires_grad_(), inputs(predictor, 3)[1][:, 0]
    after = predictor.step(state, action)[0]
    with torch.no_grad():
        for weight in predictor.model.parameters():
            weight.mul_(1.1)
    predictor.step(state.detach(), action)
    with pytest.raises(RuntimeError, match="weights changed between a prediction and its gradient"):
        after.sum().backward()


def test_state_maths_are_traced_once(quick, inputs, monkeypatch):
    predictor = quick()
    state, actions = inputs(predictor, 3)
    predictor.rollout(state, actions)
    monkeypatch.setattr(
        "torchrl_gn.dynamics.executors.native.traced_program.StateMaths", lambda *_: pytest.fail("traced")
    )
    with torch.no_grad():
        for weight in predictor.model.parameters():
            weight.mul_(1.1)
    found, expected = (
        predictor.rollout(state, actions)[0],
        specialize(predictor, executor="eager").rollout(state, actions)[0],
    )
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
    assert native(predictor).reason is None


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

    class Own(torch.Tensor):
        pass

    assert type(predictor.step(state.as_subclass(Own), actions[:, 0])[0]) is Own


@compiles
@pytest.mark.parametrize("what", ["step", pytest.param("rollout", marks=pytest.mark.slow)])
def test_compiled_callers_run_by_torch(quick, inputs, what):
    predictor = quick("pendulum", torch.float64, activation="relu")
    state, actions = inputs(predictor, 3)
    predictor.step(state, actions[:, 0])

    def function(state, actions):
        if what == "step":
            return predictor.step(state, actions[:, 0])[0] + 1
        return predictor.rollout(state, actions)[0] + 1

    compiled = torch.compile(function, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(state, actions), function(state, actions))
    with torch.no_grad():
        for weight in predictor.model.parameters():
            weight.mul_(1.1)
    torch.testing.assert_close(compiled(state, actions), function(state, actions))
    leaf = actions.clone().requires_grad_()
    gradients = [torch.autograd.grad(each(state, leaf).square().sum(), leaf)[0] for each in (compiled, function)]
    torch.testing.assert_close(*gradients)


# Threads and processes


@pytest.mark.parametrize("shared", [True, False])
def test_python_threads_step_at_once(quick, inputs, shared):
    expected_of = quick()
    predictors = [quick()] * 4 if shared else [quick() for _ in range(4)]
    data = [inputs(expected_of, count, seed=count) for count in (1, 7, 30, 50)]
    data[1][0][..., 2] += 0.1  # other constant channels: traced while others run
    expected = [pull(expected_of, *each) for each in data]
    start = threading.Barrier(4)

    def work(index: int) -> bool:
        torch.set_num_threads(1 + index % 2)
        start.wait()
        return all(equal(pull(predictors[index], *data[index]), expected[index]) for _ in range(10))

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(work, range(4)))


def test_buffers_are_lent_to_one_at_a_time():
    pool = Pool()

    def work(index: int) -> bool:
        own = True
        for count in range(3000):
            lease = pool.take(8 + count % 3, torch.float32)
            lease.tensor.fill_(index)
            own = own and bool((lease.tensor == index).all())
        return own

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as workers:
            assert all(workers.map(work, range(4)))
    finally:
        sys.setswitchinterval(interval)
    assert len(pool.free) <= 2


def test_weights_change_while_another_thread_steps(quick, inputs):
    predictor = quick(latent=64)
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
                for weight in predictor.model.parameters():
                    weight.mul_(0.99)
            predictor.step(state, actions[:, 0])
        done.set()
        assert finite.result()


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
    found = queue.get(timeout=120)
    process.join()
    np.testing.assert_array_equal(found, expected.numpy())
    assert process.exitcode == 0


def test_copies_predict_the_same(quick, inputs):
    predictor = quick()
    state, actions = inputs(predictor, 3)
    expected = predictor.rollout(state, actions)[0]
    for copied in (copy.deepcopy(predictor), pickle.loads(pickle.dumps(predictor))):
        assert torch.equal(copied.rollout(state, actions)[0], expected)
        assert native(copied) is not native(predictor)


# Features of one's own


def with_feature(fit, scene, function, **options) -> SpecializedPredictor:
    """Specialised predictor whose nodes also see ``function(state)``, ``[*B, N, 1]``."""

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
    return specialize(fit(model, scene).double().bind(scene))


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


@pytest.mark.parametrize("kind", REASONS)
def test_features_of_ones_own(fit, inputs, kind):
    function, reason = REASONS[kind]
    predictor = with_feature(fit, zoo.load("arm"), function)
    eager = specialize(predictor, executor="eager")
    state, actions = inputs(predictor, 4)
    found, expected = predictor.rollout(state, actions)[0], eager.rollout(state, actions)[0]
    if reason is None:
        assert native(predictor).reason is None
        assert (found - expected).norm() <= 1e-12 * expected.norm()
        return
    assert torch.equal(found, expected)
    given = native(predictor).reason
    assert given is not None and re.search(reason, given) and "\n" not in given
    assert f"native, but here by torch: {given}" in str(predictor)
    predictor.refresh()
    assert torch.equal(predictor.rollout(state, actions)[0], expected) and native(predictor).reason == given


def test_state_maths_with_too_many_registers(quick, inputs, monkeypatch):
    predictor = quick()
    eager = specialize(predictor, executor="eager")
    state, actions = inputs(predictor, 3)
    lifted = state + torch.eye(13, dtype=torch.float64)[2]
    predictor.rollout(state, actions)
    monkeypatch.setattr("torchrl_gn.dynamics.executors.native.tape._MOST_REGISTERS", 50)
    for shift in (0.0, 0.1):  # no room for more special or general ones
        native(predictor).native.traced.special[1:] = native(predictor).native.traced.special[:1]
        assert torch.equal(predictor.rollout(lifted + shift, actions)[0], eager.rollout(lifted + shift, actions)[0])
    assert native(predictor).reason is None
    other = quick()
    assert torch.equal(other.rollout(state, actions)[0], eager.rollout(state, actions)[0])
    assert re.search(r"needs \d+ registers", native(other).reason)


# Scenes


def zoo_cases() -> list:
    few = ("arm", "everything", "odd", "soft", "tumbler", "parallel_hinges", "quadrotor", "machine")
    return [pytest.param(name, marks=[] if name in few else pytest.mark.slow) for name in ZOO]


@pytest.mark.parametrize("name", zoo_cases())
def test_every_scene_is_traced(make_model, random_states, random_actions, name):
    scene = zoo.load(name)
    axes = () if scene.state_size != 13 else (JointAxes().resolved(scene), Contacts())
    for options in ({}, {"features": (BodyState(encoding="quaternion"), Controls(), *axes), "integrate": False}):
        if options and not axes:
            continue
        bound = make_model(scene, **options).double().requires_grad_(False).bind(scene)
        predictor, eager = (specialize(bound, executor=executor) for executor in ("native", "eager"))
        state, actions = random_states(scene, 4, seed=3), random_actions(scene, 4, 2, seed=3)
        some = random_states(scene, 20)
        varies = (some != some[0]).any(0)
        expected, found = (pull(each, state, actions) for each in (eager, predictor))
        assert native(predictor).reason is None
        for index, (wanted, got) in enumerate(zip(expected, found, strict=True)):
            wanted, got = (each * varies if index == 1 else each for each in (wanted, got))
            assert (got - wanted).norm() <= 1e-10 * wanted.norm()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["humanoid", "walker", "hopper", "swimmer"])
def test_scenes_of_the_suite_are_traced(make_model, random_states, random_actions, name):
    suite = pytest.importorskip("dm_control.suite")
    from torchrl_gn.scenes import load_scene

    scene = load_scene(Path(suite.__file__).with_name(f"{name}.xml")) if name != "swimmer" else load_scene("swimmer15")
    predictor = specialize(make_model(scene).double().bind(scene))
    state, action = random_states(scene, 3, seed=3), random_actions(scene, 3, seed=3)
    found, expected = predictor.step(state, action)[0], specialize(predictor, executor="eager").step(state, action)[0]
    assert native(predictor).reason is None
    assert (found - expected).norm() <= 1e-10 * (expected - state).norm()


@pytest.mark.parametrize("name", FEW)
def test_at_rest_gradients_are_finite(quick, name):
    """Square roots and angles at zero, as in a scene's first state."""
    predictor = quick(name, torch.float64)
    state = torch.zeros(2, predictor.scene.num_nodes, 13, dtype=torch.float64)
    state[..., 3] = 1
    actions = torch.zeros(2, 2, predictor.scene.num_actions, dtype=torch.float64)
    found, expected = (pull(each, state, actions) for each in (predictor, specialize(predictor, executor="eager")))
    torch.testing.assert_close(found[0], expected[0], rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(found[2], expected[2], rtol=1e-9, atol=1e-12)
    assert found[1].isfinite().all()
    assert native(predictor).reason is None


# The build


@pytest.fixture(scope="session")
def whole() -> bytes:
    """A good library; the other one is built before the cache folder changes."""
    load_binding()
    return Path(library.load_library()._name).read_bytes()


@pytest.fixture
def fresh(tmp_path, monkeypatch, whole):
    """An empty cache folder with a space in its name, and no library in this process."""
    folder = tmp_path / "a cache"
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder))
    monkeypatch.delenv("CXX", raising=False)
    build._library_or_reason.cache_clear()
    yield folder / "torchrl_gn"
    build._library_or_reason.cache_clear()


@pytest.fixture
def builds(monkeypatch, whole):
    """Files of libraries that are built: a good one is copied instead."""
    built: list[Path] = []

    def build_it(what, command, file: Path) -> None:
        built.append(file)
        file.write_bytes(whole)

    monkeypatch.setattr(build, "_build", build_it)
    return built


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"PATH": ""}, "There is no C++ compiler"),
        ({"CXX": "no-such-compiler"}, "There is no C++ compiler"),
        ({"CXX": sys.executable + " -c 'raise SystemExit(1)'"}, "failed"),
        ({"TORCHRL_GN_CXXFLAGS": "-no-such-option"}, "error: unrecognized"),
        ({"TORCHRL_GN_CXXFLAGS": "'"}, "No closing quotation"),
    ],
)
def test_without_a_compiler_it_runs_by_torch(fresh, quick, inputs, monkeypatch, variables, message):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    predictor = quick()
    state, actions = inputs(predictor, 3)
    found = predictor.rollout(state, actions)[0]
    reason = native(predictor).reason
    assert reason is not None and message in reason and "\n" not in reason
    assert f"native, but here by torch: {reason}" in str(predictor).splitlines()[0]
    assert torch.equal(found, specialize(predictor, executor="eager").rollout(state, actions)[0])
    monkeypatch.setattr(build, "load", lambda *_: pytest.fail("tried again"))
    with torch.no_grad():
        next(predictor.model.parameters()).mul_(1.1)
    predictor.rollout(state, actions)


def test_a_library_is_built_once(fresh, builds):
    first = library.load_library()
    build._library_or_reason.cache_clear()
    assert library.load_library()._name == first._name == str(builds[0]) and len(builds) == 1
    assert fresh in builds[0].parents


@pytest.mark.parametrize("damage", ["empty", "short", "half", "zeros", "longer"])
def test_a_damaged_library_is_built_again(fresh, builds, whole, damage):
    library.load_library()
    damaged = {
        "empty": b"",
        "short": whole[:20],
        "half": whole[: len(whole) // 2],
        "zeros": whole[:-4096] + bytes(4096),
        "longer": whole + b"x",
    }[damage]
    builds[0].unlink()  # the process has it open
    builds[0].write_bytes(damaged)
    build._library_or_reason.cache_clear()
    assert library.load_library().gn_rollout
    assert len(builds) == 2 and builds[0].read_bytes() == whole


def test_what_an_interrupted_build_leaves_is_neither_loaded_nor_kept(fresh, monkeypatch, builds):
    def interrupted(what, command, file: Path) -> None:
        file.with_name(f".{file.stem}.0123abcd.so").write_bytes(b"half")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(build, "_build", interrupted)
        with pytest.raises(KeyboardInterrupt):
            library.load_library()
    assert len(list(fresh.glob("*.so"))) == 1
    library.load_library()
    assert len(builds) == 1 and list(fresh.glob("*.so")) == builds


def test_a_folder_that_cannot_be_written_to(fresh, builds, monkeypatch):
    for variables in ({"XDG_CACHE_HOME": "/proc/no"}, {"XDG_CACHE_HOME": "", "HOME": "/proc/no"}):
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
        build._library_or_reason.cache_clear()
        assert library.load_library().gn_rollout
        assert not builds.pop().exists()

    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", homeless)
    build._library_or_reason.cache_clear()
    assert library.load_library().gn_rollout


def test_a_library_in_a_folder_that_is_read_only_is_used(fresh, builds, monkeypatch):
    library.load_library()
    build._library_or_reason.cache_clear()
    monkeypatch.setattr(Path, "mkdir", lambda *_, **__: pytest.fail("written"))
    library.load_library()
    assert len(builds) == 1


def test_a_compiler_with_arguments(fresh, monkeypatch):
    commands = []

    def build_it(what, command, file: Path) -> None:
        commands.append(command)
        raise build.NoCompilerError("no")

    monkeypatch.setattr(build, "_build", build_it)
    monkeypatch.setenv("CXX", "env 'A B=c d' g++ -DX")
    monkeypatch.setenv("TORCHRL_GN_CXXFLAGS", "-DNAME='a b' -O0")
    with pytest.raises(build.NoCompilerError):
        library.load_library()
    assert commands[0][:4] == ["env", "A B=c d", "g++", "-DX"] and commands[0][-2:] == ["-DNAME=a b", "-O0"]


BUILD = """
from torchrl_gn.dynamics.executors.native import library
library.load_library().gn_rollout
"""


@pytest.mark.slow
@pytest.mark.parametrize("compiler", ["g++", "clang++"])
def test_two_processes_build_at_once(tmp_path, compiler):
    if shutil.which(compiler) is None:
        pytest.skip(f"there is no {compiler}")
    folder = tmp_path / "a cache"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(folder), "CXX": f"env {compiler}"}
    environment["TORCHRL_GN_CXXFLAGS"] = "-O1"
    command = [sys.executable, "-c", BUILD]
    both = [subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    messages = [process.communicate()[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], messages
    assert sum("Building the native executor" in message for message in messages) == 1
    (file,) = (folder / "torchrl_gn").glob("*.so")
    content = file.read_bytes()
    assert hashlib.sha256(content[:-32]).digest() == content[-32:]
    ctypes.CDLL(str(file))


SANITIZED = """
import torch
from tests import zoo
from torchrl_gn.dynamics import ForwardModel, specialize
from torchrl_gn.dynamics.executors.native import executor, library
for name in ("swimmer6", "joints"):
    scene = zoo.load(name)
    for sizes in ({"latent": 6, "hidden": (8,)}, {"latent": 20, "hidden": (36,), "activation": "gelu"}):
        for dtype in (torch.float32, torch.float64, torch.bfloat16):
            if dtype == torch.bfloat16 and not library.load_library().gn_has_bfloat16():
                continue
            products, dtype = dtype, torch.float32 if dtype == torch.bfloat16 else dtype
            model = ForwardModel.for_scene(scene, **sizes).to(dtype)
            for normalizer in model.modules():
                if hasattr(normalizer, "m2"):
                    ones = {key: torch.ones_like(value) for key, value in normalizer.state_dict().items()}
                    normalizer.load_state_dict(ones)
            predictor = specialize(model.bind(scene), dtype=products)
            for count in (1, 3, 7, 13, 24, 50):
                for threads in (1, 3):
                    torch.set_num_threads(threads)
                    state = torch.zeros(count, scene.num_nodes, 13, dtype=torch.float64)
                    state[..., 3] = 1
                    actions = torch.zeros(count, 3, scene.num_actions, dtype=torch.float64)
                    predictor.step(state, actions[:, 0])
                    state.requires_grad_(), actions.requires_grad_()
                    for executor.STORED_BYTES in (2**28, 0):
                        predictor.rollout(state, actions)[0].sum().backward()
                        predictor.step(state, actions[:, 0])[0].sum().backward()
            assert predictor.executor().reason is None, predictor.executor().reason
            of_samples = specialize(model.bind(scene, parameters_key="parameters"), dtype=products)
            for count in (2, 25, 50):
                torch.set_num_threads(3)
                parameters = of_samples.own_parameters().expand(count).clone()
                parameters["child_anchor"] *= 1 + 0.1 * torch.rand(count, 1, 1, dtype=torch.float64)
                state = torch.eye(13, dtype=torch.float64)[3].repeat(count, scene.num_nodes, 1).requires_grad_()
                actions = torch.zeros(count, 3, scene.num_actions, dtype=torch.float64, requires_grad=True)
                for executor.STORED_BYTES in (2**28, 0):
                    of_samples.rollout(state, actions, parameters)[0].sum().backward()
            assert of_samples.executor(parameters).native.samples.count == 50
            for _ in range(3):
                of_samples.step(state, actions[:, 0])
            for count in (1, 5, 130):
                torch.set_num_threads(2)
                trained = model.bind(scene).training_executor()
                trained.delta(state[:1].expand(count, -1, -1), actions[:1, 0].expand(count, -1))[0].sum().backward()
                torch.set_num_threads(1)
            assert trained.reason is None, trained.reason
print("fine")
"""


@pytest.mark.slow
def test_sanitizers_find_nothing(tmp_path):
    def where(name: str) -> str:
        return subprocess.run(["g++", f"-print-file-name={name}"], capture_output=True, text=True).stdout.strip()

    libraries = [where("libasan.so"), where("libubsan.so"), where("libstdc++.so.6")]
    if not all(map(os.path.isabs, libraries)):
        pytest.skip("there are no sanitizers")
    flags = "-fsanitize=address,undefined -fno-sanitize-recover=undefined -O1"
    done = run(
        SANITIZED,
        check=False,
        XDG_CACHE_HOME=str(tmp_path),
        CXX="g++",
        TORCHRL_GN_CXXFLAGS=flags,
        LD_PRELOAD=" ".join(map(os.path.realpath, libraries)),
        ASAN_OPTIONS="detect_leaks=0",
    )
    assert done.returncode == 0 and "fine" in done.stdout, done.stderr[-4000:]
