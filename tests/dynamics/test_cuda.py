"""The executor for GPUs: its kernels' source runs here, on the processor, one sample after the other."""

from __future__ import annotations

import copy
import ctypes
import re
import subprocess
import warnings

import numpy as np
import pytest
import torch

from torchrl_gn.dynamics import ForwardModel, specialize
from torchrl_gn.dynamics.bound import UnseenParameterWarning
from torchrl_gn.dynamics.executors import eager
from torchrl_gn.dynamics.executors.cuda import CudaExecutor, nvrtc, source
from torchrl_gn.dynamics.executors.cuda.nvrtc import THREADS
from torchrl_gn.dynamics.executors.native.build import find_compiler
from torchrl_gn.scenes import load_scene, sample_variants

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="there is no C++ compiler")

SCENES = ("swimmer6", "cheetah", "joints")

_HOST = """\
#include <cmath>
#include <cstring>
using namespace std;
#define __global__
#define __device__
#define __forceinline__ inline
#define __launch_bounds__(count)
#define __restrict__ __restrict
struct Index { long long x, y; };
static Index blockIdx, threadIdx;
template <class A, class B> A same_bits(B b) { A a; memcpy(&a, &b, sizeof a); return a; }
#define __longlong_as_double same_bits<double, long long>
#define __uint_as_float same_bits<float, unsigned>
#define __float_as_uint same_bits<unsigned, float>
"""


@pytest.fixture(scope="module")
def host(tmp_path_factory):
    """Kernels compiled for the processor."""
    folder, built = tmp_path_factory.mktemp("kernels"), {}

    def make(name, source):
        kinds = re.search(rf"\) {name}\((.*?)\) {{", source, re.DOTALL)[1].split(",")
        kinds = [kind.replace("__restrict__", "").rsplit(maxsplit=1)[0] for kind in kinds]
        given = ", ".join(f"({k})a[{i}]" if "*" in k else f"*({k}*)a[{i}]" for i, k in enumerate(kinds))
        run = f"""
extern "C" void run(long long count, long long rows, void** a) {{
  for (blockIdx.y = 0; blockIdx.y < rows; ++blockIdx.y)
    for (long long i = 0; i < count + 7; ++i) {{
      blockIdx.x = i / {THREADS}, threadIdx.x = i % {THREADS};
      {name}({given});
    }}
}}
"""
        text = _HOST + source + run
        if text not in built:
            place = folder / f"{name}{len(built)}"
            place.with_suffix(".cpp").write_text(text)
            command = [*find_compiler(), "-O0", "-shared", "-fPIC", "-w", str(place.with_suffix(".cpp"))]
            subprocess.run([*command, "-o", str(place.with_suffix(".so"))], check=True)
            built[text] = ctypes.CDLL(str(place.with_suffix(".so"))).run

        def launch(count, *arguments, rows=1):
            assert len(arguments) == len(kinds)
            values, places = [], []
            for kind, each in zip(kinds, arguments, strict=True):
                assert isinstance(each, int) == ("*" not in kind) and (isinstance(each, int) or each.is_contiguous())
                values.append(ctypes.c_longlong(each) if isinstance(each, int) else each)
                pointer = ctypes.addressof(values[-1]) if isinstance(each, int) else each.data_ptr()
                places.append(pointer)
            built[text](ctypes.c_longlong(count), ctypes.c_longlong(rows), (ctypes.c_void_p * len(places))(*places))

        return launch

    return make


def _pull(function, *inputs, wrt=()):
    leaves = [each.detach().clone().requires_grad_() for each in inputs]
    out = function(*leaves)
    weights = torch.linspace(-1, 1, out[0].numel(), dtype=out.dtype, device=out.device).view(out.shape[1:])
    options = {"allow_unused": True, "materialize_grads": True, "retain_graph": True}
    return [out.detach(), *torch.autograd.grad((out * weights).sum(), [*leaves, *wrt], **options)]


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rollouts_and_gradients_are_those_of_torch(host, wide, inputs, name, dtype):
    program = specialize(wide(name, torch.float64), executor="eager").program()
    executor = CudaExecutor(program, make=host)
    assert executor.reason is None
    state, actions = inputs(wide(name, torch.float64), 2, 3)
    wanted = _pull(lambda *given: eager.rollout(program, *given)[0], state, actions)
    found = _pull(lambda *given: executor.rollout(program, *given)[0], state.to(dtype), actions.to(dtype))
    step = executor.step(program, state.to(dtype), actions[:, :, 0].to(dtype))[0]
    assert all(each.dtype == dtype for each in (*found, step))
    tolerance = {"rtol": 1e-9, "atol": 1e-9} if dtype == torch.float64 else {"rtol": 1e-3, "atol": 1e-3}
    for a, b in zip(found, wanted, strict=True):
        torch.testing.assert_close(a.double(), b, **tolerance)
    torch.testing.assert_close(step, found[0][:, :, 1])


_HILLS = """<mujoco><asset><hfield name="h" nrow="3" ncol="3" size="2 2 .3 .1" elevation="0 1 0 1 0 1 0 0 1"/></asset>
<worldbody><geom type="hfield" hfield="h"/>
<body name="ball"><freejoint/><geom type="sphere" size=".1"/></body></worldbody></mujoco>"""


@pytest.mark.slow
def test_heights_below_a_body_are_looked_up(host, fit):
    scene = load_scene(_HILLS)
    torch.manual_seed(0)
    model = fit(ForwardModel.for_scene(scene, latent=4, hidden=8), scene).double().requires_grad_(False)
    program = specialize(model.bind(scene), executor="eager").program()
    state = torch.as_tensor(scene.reference_state).repeat(12, 1, 1)
    generator = torch.Generator().manual_seed(0)
    state[:, 1, :3] = 1.8 * torch.rand(12, 3, generator=generator, dtype=torch.float64) - 0.9
    state[:, 1, 2] = 0.3
    actions = state.new_zeros(12, 2, 0)
    executor = CudaExecutor(program, make=host)
    assert executor.reason is None
    runs = (eager, executor)
    for a, b in zip(
        *(_pull(lambda *given, r=r: r.rollout(program, *given)[0], state, actions) for r in runs), strict=True
    ):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


def test_without_cudas_compiler_torch_runs_it(wide, inputs, monkeypatch):
    def missing():
        raise nvrtc.NoCudaCompilerError("libnvrtc is not there")

    monkeypatch.setattr(nvrtc, "_compiler", missing)
    program = specialize(wide("swimmer6"), executor="eager").program()
    executor = CudaExecutor(program)
    assert executor.reason == "libnvrtc is not there"
    state, actions = inputs(wide("swimmer6"), 2)
    found, wanted = (run.rollout(program, state, actions)[0] for run in (executor, eager))
    assert torch.equal(found, wanted)


@pytest.mark.slow
def test_long_state_maths_is_split_into_kernels(host, wide, inputs, monkeypatch):
    program = specialize(wide("swimmer6", torch.float64), executor="eager").program()
    state, actions = inputs(wide("swimmer6", torch.float64), 3)
    found = []
    for part in (source._PART, 1000):
        monkeypatch.setattr(source, "_PART", part)
        executor = CudaExecutor(program, make=host)
        found.append(_pull(lambda *given, run=executor: run.rollout(program, *given)[0], state, actions))
        counts = [len(kernels) for kernels, _ in executor._kernels._kernels.values()]
        assert max(counts) > 4 if part == 1000 else max(counts) == 2
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("core", ["gn", "mlp"])
def test_changes_have_gradients_of_weights(host, scenes, fit, inputs, core):
    torch.manual_seed(0)
    model = fit(ForwardModel.for_scene(scenes["swimmer6"], core=core), scenes["swimmer6"]).double()
    predictor = model.bind(scenes["swimmer6"])
    state, actions = inputs(predictor, 5)
    weights = list(model.core.parameters())
    program = predictor.program(reduced=True)
    executor = CudaExecutor(program, change=True, graphs=False, make=host)
    both = [
        _pull(lambda *given, run=run: run(program, *given)[0], state, actions[:, 0], wrt=weights)
        for run in (eager.delta, executor.delta)
    ]
    for a, b in zip(*both, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_the_network_may_be_compiled(host, wide, inputs):
    program = specialize(wide("swimmer6"), executor="eager").program()
    state, actions = inputs(wide("swimmer6"), 5)
    ways = [CudaExecutor(program, make=host, compiles=compiles) for compiles in (False, True)]
    found = [_pull(lambda *given, run=way: run.rollout(program, *given)[0], state, actions) for way in ways]
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_samples_bring_parameters(host, wide, scenes, inputs):
    bound = wide("swimmer6", torch.float64)
    model = bound.model
    variants = sample_variants("swimmer6", 4, np.random.default_rng(0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnseenParameterWarning)
        predictor = model.bind(scenes["swimmer6"], parameters_key="parameters")
        parameters = torch.stack([predictor.parameters_of(variant) for variant in variants])
    program = predictor.program(parameters, reduced=True)
    executor = CudaExecutor(program, graphs=False, make=host)
    assert executor.reason is None and len(executor.parameters) > 0
    torch.testing.assert_close(
        executor.parameters._read_there(program.parameters), executor.parameters.read(program.parameters)
    )
    state, actions = inputs(bound, 4)
    both = [_pull(lambda *given, run=run: run.rollout(program, *given)[0], state, actions) for run in (eager, executor)]
    for a, b in zip(*both, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::torchrl_gn.processor.SlowDtypeWarning")
def test_bfloat16_reaches_the_network_rounded_to_nearest(host, wide, inputs):
    program = specialize(wide("swimmer6"), executor="eager", dtype=torch.bfloat16).program()
    executor = CudaExecutor(program, make=host)
    state, actions = inputs(wide("swimmer6"), 5)
    wanted, found = (run.step(program, state, actions[:, 0])[0] for run in (eager, executor))
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-4)


needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


@pytest.mark.gpu
@needs_gpu
@pytest.mark.parametrize("name", SCENES)
def test_a_gpu_computes_what_the_processor_does(wide, inputs, name):
    predictor = wide(name, torch.float64)
    there = copy.deepcopy(predictor.model).cuda().bind(predictor.scene)
    state, actions = inputs(predictor, 600)
    wanted = _pull(lambda *given: specialize(predictor, executor="eager").rollout(*given)[0], state, actions)
    for executor in ("native", "eager"):
        specialized = specialize(there, executor=executor)
        assert specialized.reason is None
        found = _pull(lambda *given, run=specialized: run.rollout(*given)[0], state.cuda(), actions.cuda())
        for a, b in zip(found, wanted, strict=True):
            torch.testing.assert_close(a.cpu(), b, rtol=1e-8, atol=1e-8)
    with torch.no_grad():
        live = there.rollout(state.cuda(), actions.cuda())[0]
    torch.testing.assert_close(live.cpu(), wanted[0], rtol=1e-8, atol=1e-8)
    moved = specialize(there).to("cpu")
    assert moved.reason == "on cpu, it runs by torch operations"
    torch.testing.assert_close(moved.rollout(state, actions)[0], wanted[0], rtol=1e-8, atol=1e-8)


@pytest.mark.gpu
@needs_gpu
def test_recorded_steps_follow_new_weights_and_other_batches(wide, inputs):
    predictor = wide("swimmer6")
    model = copy.deepcopy(predictor.model).cuda()
    specialized = specialize(model.bind(predictor.scene))
    for scale, count in ((1.0, 5), (1.1, 5), (1.1, 7), (0.9, 5)):
        with torch.no_grad():
            for weight in model.parameters():
                weight.mul_(scale)
        specialized.refresh(model.bind(predictor.scene))
        state, actions = (each.cuda() for each in inputs(predictor, count))
        wanted = specialize(model.bind(predictor.scene), executor="eager").rollout(state, actions)[0]
        torch.testing.assert_close(specialized.rollout(state, actions)[0], wanted, rtol=0, atol=1e-5)
