"""Report on this machine (``torchrl-gn doctor``)."""

from __future__ import annotations

import platform
import re
import sys
import time
from functools import partial

import torch
from tqdm import tqdm

from torchrl_gn.data import collect_trajectories, trajectory_buffer
from torchrl_gn.dynamics import specialize
from torchrl_gn.dynamics.executors.native.build import compiler_version, find_compiler
from torchrl_gn.maths import fast_matmul
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.processor import instruction_sets, processor_name, product_speeds, restrictions, usable_cores
from torchrl_gn.scenes import require_bodies
from torchrl_gn.training import load_pretrained
from torchrl_gn.training.checkpoint import package_versions

_MODEL = "swimmer6"
_BATCHES = (1, 200, 2000)
_ROUNDS = 5
_MIN_GAIN = 1.3  # smallest speed-up for which to recommend more threads


def diagnose() -> str:
    """Return a report on hardware, libraries and speeds, with recommended options; takes a few seconds."""
    threads = usable_cores()
    seconds, compiler = _thread_seconds(threads), _compiler()
    gpus = [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())]
    limited = " ".join(restrictions())
    sections = {
        "System": [
            ("platform", platform.platform()),
            ("processor", processor_name()),
            ("cores of this process", str(threads)),
            ("instruction sets", instruction_sets()),
            ("torch uses", torch.backends.cpu.get_cpu_capability()),
            *([("restricted by", limited)] if limited else []),
            ("GPU", ", ".join(gpus) or "none"),
        ],
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


def _libraries() -> list[tuple[str, str]]:
    patterns = {
        "MKL": r"Math Kernel Library Version ([\w.-]+)",
        "oneDNN": r"MKL-DNN v([\w.]+)",
        "BLAS": r"BLAS_INFO=(\w+)",
    }
    matches = {name: re.search(pattern, torch.__config__.show()) for name, pattern in patterns.items()}
    rows = [(name, match[1]) for name, match in matches.items() if match]
    return [*rows, ("torch threads", str(torch.get_num_threads()))]


def _products() -> list[tuple[str, str]]:
    speeds = product_speeds()
    onednn = f"{speeds.onednn:.0f}" + (", with rounded factors" if speeds.onednn_error > 1e-5 else "")
    rows = [(name, f"{getattr(speeds, name):.0f}") for name in ("float64", "float32", "bfloat16", "float16")]
    rows.insert(2, ("float32, oneDNN", onednn if speeds.onednn else "not selectable in this version of torch"))
    return rows


def _thread_seconds(threads: int) -> dict[str, tuple[float, float]]:
    loaded = load_pretrained(_MODEL)
    scene = require_bodies(loaded.scene(), "The measurement")
    bound = loaded.model.bind(scene)
    specialized, loss = specialize(bound), ForwardModelLoss(bound)
    batch = trajectory_buffer(collect_trajectories(scene, 20, seed=0), batch_size=max(_BATCHES), seed=0).sample()

    def predict(count: int) -> None:
        with torch.no_grad(), fast_matmul():
            specialized.step(batch["state"][:count], batch["action"][:count])

    def train() -> None:
        with fast_matmul():
            loss(batch[:200])["loss_forward_model"].backward()

    tasks = {**{f"step of {count:,}": partial(predict, count) for count in _BATCHES}, "gradient of 200": train}
    before, seconds = torch.get_num_threads(), {}
    try:
        for name, task in tqdm(tasks.items(), desc="measuring", leave=False):
            best = {1: float("inf"), threads: float("inf")}
            for _ in range(_ROUNDS):
                for count in best:
                    torch.set_num_threads(count)
                    start = time.perf_counter()
                    task()
                    best[count] = min(best[count], time.perf_counter() - start)
            seconds[name] = best[1], best[threads]
    finally:
        torch.set_num_threads(before)
    return seconds


def _compiler() -> str | None:
    try:
        return None if (command := find_compiler()) is None else compiler_version(command) or None
    except (OSError, ValueError):  # ValueError: unbalanced quotes in CXX
        return None


def _advice(seconds: dict[str, tuple[float, float]], threads: int, compiler: bool, gpu: bool) -> list[str]:
    products = product_speeds()
    slower = products.slowdown(torch.bfloat16)
    lines = [
        "specialize(model) for prediction, evaluation and planning"
        + (": it runs in C++" if compiler else "; install g++, so that it and training run in C++"),
        f"dtype=torch.bfloat16 for large batches: products {1 / slower:.1f} times as fast, 3 digits"
        if slower < 0.8
        else f"no dtype=torch.bfloat16: products take {slower:.1f} times as long as in float32",
    ]
    if products.onednn_pays:
        gain = products.onednn / products.float32
        lines.append(f"fast_matmul() around large batches by torch: float32 products {gain:.1f} times as fast")
    else:
        why = "rounds the factors" if products.onednn_error > 1e-5 else "is not faster"
        lines.append(f"no fast_matmul(): oneDNN {why}")
    one, all_ = seconds["gradient of 200"]
    if threads > 1:
        lines.append(
            f"threads={threads} in recipes while nothing else runs: training {one / all_:.1f} times as fast"
            if one > _MIN_GAIN * all_
            else f"threads=1 in recipes: on {threads} threads training is {one / all_:.1f} times as fast"
        )
    lines.append("device=cuda in recipes" if gpu else "device=cpu: torch sees no GPU")
    return lines
