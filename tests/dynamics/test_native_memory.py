"""The native executor's memory: none left is an error, and sanitizers find no fault."""

from __future__ import annotations

import os
import subprocess

import pytest

from .native import run, with_compiler

pytestmark = [with_compiler, pytest.mark.slow]


LEVELS = 6  # of memory left; 20, by hand, take three times as long
OUT_OF_MEMORY = """
import ctypes, os, resource, sys, torch
from tests import zoo
from torchrl_gn.dynamics import ForwardModel, specialize
scene = zoo.load("swimmer3")
torch.manual_seed(0)
torch.set_num_threads(1)
model = ForwardModel.for_scene(scene, latent=64, hidden=(256,))
for normalizer in model.modules():
    if hasattr(normalizer, "m2"):
        normalizer.load_state_dict({name: torch.ones_like(each) for name, each in normalizer.state_dict().items()})
bound = model.bind(scene)
fast = specialize(bound)
assert fast.reason is None
count = 1000
state = bound.reference_state.expand(count, -1, -1).clone()
actions = torch.zeros(count, 3, scene.num_actions, dtype=torch.float64)
fast.rollout(state[:1].requires_grad_(), actions[:1])[0].sum().backward()
bound.prepared_for_training().delta(state[:1].detach(), actions[:1, 0])[0].sum().backward()
state = state.detach()
plain = torch.zeros(16 * 256**2)
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]


def fill(room) -> dict:
    '''Take all memory, in blocks of 1 MiB and smaller that hold the last one's address, then give so much back.'''
    pages, last = int(open("/proc/self/statm").read().split()[0]), {2**20: None, 2**16: None, 2**12: None}
    resource.setrlimit(resource.RLIMIT_AS, (4096 * pages + 2**25, -1))
    for size in last:
        while block := libc.malloc(size):
            ctypes.c_void_p.from_address(block).value, last[size] = last[size], block
    free(last, room)
    return last


def free(last, room) -> None:
    for size in last:
        while last[size] and room > 0:
            block, last[size] = last[size], ctypes.c_void_p.from_address(last[size]).value
            libc.free(block)
            room -= size


def tried(which, threads, room) -> str:
    torch.set_num_threads(threads)
    torch.ones(10**6).sin().sum()  # torch's own threads begin
    prepared = bound.prepared_for_training()
    if which == "gradient":
        out = fast.rollout(state.requires_grad_(), actions)[0].sum()
    elif which == "training":
        out = prepared.delta(state, actions[:, 0])[0].sum()
    blocks = fill(room * 2**20)
    try:
        if which == "rollout":
            fast.rollout(state, actions)
        elif which == "pack":
            torch.ops.torchrl_gn.pack(plain, [256] * 32, True)
        else:
            out.backward()
        found = "fine"
    except (MemoryError, torch.OutOfMemoryError):
        found = "MemoryError"
    except RuntimeError as error:  # of torch's own operations
        found = "MemoryError" if "you tried to allocate" in str(error) else str(error)
    free(blocks, 2**40)
    resource.setrlimit(resource.RLIMIT_AS, (-1, -1))
    fast.rollout(state[:9].detach(), actions[:9])  # works again
    return found


levels = int(sys.argv[1])
for which in ("rollout", "gradient", "training", "pack"):
    for threads in (1, 3):
        for room in (0.1 * 200 ** (level / (levels - 1)) for level in range(levels)):  # MiB, up to 20
            if child := os.fork():
                assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0, (which, threads, room)
                continue
            print(which, threads, tried(which, threads, room), flush=True)
            os._exit(0)
"""


def test_without_memory_there_is_an_error_and_no_signal():
    done = run(OUT_OF_MEMORY, LEVELS, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    seen = [line.split(maxsplit=2) for line in done.stdout.splitlines()]
    assert len(seen) == 8 * LEVELS
    assert {found for *_, found in seen} <= {"MemoryError", "fine"}, seen
    assert len({(which, threads) for which, threads, found in seen if found == "MemoryError"}) == 8, seen


SANITIZED = """
import torch
from tests import zoo
from torchrl_gn.dynamics import ForwardModel, specialize
from torchrl_gn.dynamics.executors.native.operators import load_operators
operators = load_operators()
small, wide = {"latent": 6, "hidden": (8,)}, {"latent": 20, "hidden": (36,), "activation": "gelu"}
kinds = [("pendulum", small, "float64"), ("swimmer3", wide, "float32 bfloat16")]
for name, sizes, dtypes in kinds:
    scene = zoo.load(name)
    for dtype in (getattr(torch, each) for each in dtypes.split()):
        if dtype == torch.bfloat16 and not operators.has_bfloat16():
            continue
        products, dtype = dtype, torch.float32 if dtype == torch.bfloat16 else dtype
        model = ForwardModel.for_scene(scene, **sizes).to(dtype)
        for normalizer in model.modules():
            if hasattr(normalizer, "m2"):
                ones = {key: torch.ones_like(value) for key, value in normalizer.state_dict().items()}
                normalizer.load_state_dict(ones)
        bound = model.bind(scene)
        predictor = specialize(bound, dtype=products)
        assert predictor.reason is None, predictor.reason
        for count in (1, 7, 24, 50):
            for threads in (1, 3):
                torch.set_num_threads(threads)
                rest = bound.reference_state.expand(count, -1, -1).clone()
                rest[count // 2 :, :, 2] += 0.1 * (threads > 1)  # other state maths, or both
                actions = torch.zeros(count, 3, scene.num_actions, dtype=torch.float64)
                predictor.step(rest, actions[:, 0])
                rest.requires_grad_(), actions.requires_grad_()
                predictor.rollout(rest, actions)[0].sum().backward()
                predictor.step(rest, actions[:, 0])[0].sum().backward()
        of_samples = specialize(model.bind(scene, parameters_key="parameters"), dtype=products)
        torch.set_num_threads(3)
        for count in (2, 25, 50):
            parameters = of_samples.own_parameters().expand(count).clone()
            parameters["child_anchor"] *= 1 + 0.1 * torch.rand(count, 1, 1, dtype=torch.float64)
            state = torch.eye(13, dtype=torch.float64)[3].repeat(count, scene.num_nodes, 1).requires_grad_()
            actions = torch.zeros(count, 3, scene.num_actions, dtype=torch.float64, requires_grad=True)
            of_samples.rollout(state, actions, parameters)[0].sum().backward()
            of_samples.step(state, actions[:, 0], parameters)[0].sum().backward()
            assert of_samples.prepared(parameters).executor.reason is None
        for count in (1, 5, 130):
            trained = bound.prepared_for_training()
            assert trained.executor.reason is None
            start, action = state[:1].expand(count, -1, -1), actions[:1, 0].expand(count, -1)
            trained.delta(start, action)[0].sum().backward()
            if count > 1:
                bound.rollout(start, action.unsqueeze(1).expand(-1, 30, -1))[0].sum().backward()
        torch.set_num_threads(1)
from tests.dynamics.malformed import main
assert main(["--rounds", "400"]) == 0
print("fine")
"""


def test_sanitizers_find_nothing(tmp_path):
    def where(name: str) -> str:
        return subprocess.run(["g++", f"-print-file-name={name}"], capture_output=True, text=True).stdout.strip()

    libraries = [where("libasan.so"), where("libubsan.so"), where("libstdc++.so.6")]
    if not all(map(os.path.isabs, libraries)):
        pytest.skip("there are no sanitizers")
    flags = "-fsanitize=address,undefined -fno-sanitize-recover=undefined -O0"
    done = run(
        SANITIZED,
        check=False,
        XDG_CACHE_HOME=str(tmp_path),
        CXX="g++",
        TORCHRL_GN_CXXFLAGS=flags,
        LD_PRELOAD=" ".join(map(os.path.realpath, libraries)),
        ASAN_OPTIONS="detect_leaks=0:allocator_may_return_null=1",  # as malloc does
    )
    assert done.returncode == 0 and "fine" in done.stdout, done.stdout[-2000:] + done.stderr[-4000:]
