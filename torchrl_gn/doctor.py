"""What this machine has, how fast it multiplies, and what to switch on here: ``torchrl-gn doctor``."""

from __future__ import annotations

import os
import platform
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial

import torch
from tqdm import tqdm

from torchrl_gn.data import collect_trajectories, trajectory_buffer
from torchrl_gn.dynamics import specialize
from torchrl_gn.maths import fast_matmul
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.pretrained import load_pretrained
from torchrl_gn.processor import instruction_sets, processor_name, product_speeds, restrictions
from torchrl_gn.training.checkpoint import package_versions

_MODEL = "swimmer6"
_BATCHES = (1, 200, 2000)
_ROUNDS = 5
_GAIN = 1.3  # of more threads, to be worth their cores


def diagnose() -> str:
    """Describe processor, libraries and speeds of this machine, with advice at the end.

    Takes a few seconds. Bug reports begin with it.

    Returns:
        Lines of text.
    """
    threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    seconds = _thread_seconds(threads)
    compiler, gpus = _compiler(), _gpus()
    sections = {
        "System": [*_system(threads), ("GPU", ", ".join(gpus) or "none")],
        "Versions": [("python", sys.version.split()[0]), *package_versions().items()],
        "Libraries": [*_libraries(), ("C++ compiler", compiler or "none")],
        "Matrix products on one thread, GFLOP/s": _products(),
        f"{_MODEL}, ms on 1 and {threads} threads": [
            (name, f"{1e3 * one:.1f} and {1e3 * all_:.1f}") for name, (one, all_) in seconds.items()
        ],
    }
    lines = []
    for title, rows in sections.items():
        lines += [title, *(f"  {name:<24}{value}" for name, value in rows), ""]
    advice = _advice(seconds, threads, compiler is not None, bool(gpus))
    return "\n".join([*lines, "What to switch on here", *(f"  - {line}" for line in advice)])


def _system(threads: int) -> list[tuple[str, str]]:
    limited = restrictions()
    return [
        ("platform", platform.platform()),
        ("processor", processor_name()),
        ("cores of this process", str(threads)),
        ("instruction sets", instruction_sets()),
        ("torch uses", torch.backends.cpu.get_cpu_capability()),
        *([("restricted by", " ".join(limited))] if limited else []),
    ]


def _libraries() -> list[tuple[str, str]]:
    said = torch.__config__.show()
    found = {
        "MKL": r"Math Kernel Library Version ([\w.-]+)",
        "oneDNN": r"MKL-DNN v([\w.]+)",
        "BLAS": r"BLAS_INFO=(\w+)",
    }
    rows = [(name, match[1]) for name, pattern in found.items() if (match := re.search(pattern, said))]
    return [*rows, ("torch threads", str(torch.get_num_threads()))]


def _products() -> list[tuple[str, str]]:
    speeds = product_speeds()
    onednn = f"{speeds.onednn:.0f}" + (", with rounded factors" if speeds.onednn_error > 1e-5 else "")
    return [
        ("float64", f"{speeds.float64:.0f}"),
        ("float32", f"{speeds.float32:.0f}"),
        ("float32, oneDNN", onednn if speeds.onednn else "cannot be chosen in this torch"),
        ("bfloat16", f"{speeds.bfloat16:.0f}"),
        ("float16", f"{speeds.float16:.0f}"),
    ]


def _thread_seconds(threads: int) -> dict[str, tuple[float, float]]:
    """Seconds of predictions and of a training step on one and on all threads; the least of some, taken in turn."""
    loaded = load_pretrained(_MODEL)
    bound = loaded.model.bind(loaded.scene())
    quick, loss = specialize(bound), ForwardModelLoss(bound)
    batch = trajectory_buffer(collect_trajectories(bound.scene, 20, seed=0), batch_size=max(_BATCHES), seed=0).sample()

    def predict(count: int) -> None:
        with torch.no_grad(), fast_matmul():
            quick.step(batch["state"][:count], batch["action"][:count])

    def train() -> None:
        with fast_matmul():
            loss(batch[:200])["loss_forward_model"].backward()

    works: dict[str, Callable[[], None]] = {f"step of {count:,}": partial(predict, count) for count in _BATCHES}
    works["gradient of 200"] = train
    before, found = torch.get_num_threads(), {}
    try:
        for name, work in tqdm(works.items(), desc="measuring", leave=False):
            best = {1: float("inf"), threads: float("inf")}
            for _ in range(_ROUNDS):
                for count in best:
                    torch.set_num_threads(count)
                    start = time.perf_counter()
                    work()
                    best[count] = min(best[count], time.perf_counter() - start)
            found[name] = best[1], best[threads]
    finally:
        torch.set_num_threads(before)
    return found


def _compiler() -> str | None:
    """First line of what the C++ compiler says of itself, the one that torch.compile calls."""
    command = os.environ.get("CXX") or shutil.which("g++") or shutil.which("clang++")
    if not command:
        return None
    try:
        done = subprocess.run([command, "--version"], capture_output=True, text=True, timeout=30)
    except OSError:
        return None
    return done.stdout.splitlines()[0] if done.returncode == 0 and done.stdout else None


def _gpus() -> list[str]:
    return [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())]


def _advice(seconds: dict[str, tuple[float, float]], threads: int, compiler: bool, gpu: bool) -> list[str]:
    products = product_speeds()
    lines = ["specialize(model) for prediction, evaluation and planning"]
    lines.append(
        "specialize(model, compile=True) for few states at a time and for planning"
        if compiler
        else "no compile=True: install g++ first (5 to 8 times faster steps of few states)"
    )
    slower = products.slowdown(torch.bfloat16)
    lines.append(
        f"dtype=torch.bfloat16 for large batches: products {1 / slower:.1f} times as fast, 3 digits"
        if slower < 0.8
        else f"no dtype=torch.bfloat16: products take {slower:.1f} times as long as in float32"
    )
    if products.onednn_pays:
        gain = products.onednn / products.float32
        lines.append(f"fast_matmul() around large batches: float32 products {gain:.1f} times as fast")
    else:
        lines.append("no fast_matmul(): oneDNN " + ("rounds" if products.onednn_error > 1e-5 else "gains nothing"))
    one, all_ = seconds["gradient of 200"]
    if threads > 1:
        lines.append(
            f"threads={threads} in recipes while nothing else runs: training {one / all_:.1f} times as fast"
            if one > _GAIN * all_
            else f"threads=1 in recipes: on {threads} threads training is {one / all_:.1f} times as fast"
        )
    lines.append("device=cuda in recipes" if gpu else "device=cpu: torch sees no GPU")
    return lines
