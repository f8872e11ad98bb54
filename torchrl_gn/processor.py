"""Speed of matrix products on this processor, measured once and cached on disk."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import platform
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchrl_gn.cache import read_cached, write_cached

_ROWS, _SIZE = 1400, 128  # a layer of 200 Swimmer6 states
_FLOP = 2 * _ROWS * _SIZE**2
_ROUNDS = 7
_LIMITS = ("ATEN_CPU_CAPABILITY", "ONEDNN_MAX_CPU_ISA", "DNNL_MAX_CPU_ISA", "MKL_ENABLE_INSTRUCTIONS")


class _Native(threading.local):
    threads = 0


_native = _Native()


def native_threads() -> int:
    """Return the number of threads of C++ code: torch's earlier number within :func:`threads_for_native`, else 0.

    With 0, C++ code uses as many threads as torch.
    """
    return _native.threads


@contextlib.contextmanager
def threads_for_native() -> Iterator[None]:
    """Leave torch's threads to C++ code until the block ends; torch's own operations run on one thread.

    Use it around small torch operations between calls of C++ code: torch's idle threads busy-wait and would take cores
    from the C++ code.
    """
    before, count = native_threads(), torch.get_num_threads()
    _native.threads = before or count
    if count > 1:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        _native.threads = before
        if count > 1:
            torch.set_num_threads(count)


class SlowDtypeWarning(UserWarning):
    """This processor multiplies the chosen dtype more slowly than float32."""


@dataclass(frozen=True)
class ProductSpeeds:
    """Speed of matrix products on one thread, GFLOP/s."""

    float64: float
    float32: float  # by torch's default library
    onednn: float  # float32 by oneDNN; 0 if this version of torch cannot select it
    bfloat16: float
    float16: float
    onednn_error: float  # relative; above 1e-5 if oneDNN rounds the factors

    @property
    def onednn_pays(self) -> bool:
        """True if oneDNN is faster in float32 at the same precision."""
        return self.onednn_error < 1e-5 and self.onednn > 1.1 * self.float32

    def slowdown(self, dtype: torch.dtype) -> float:
        """Return the time of a product in a 16-bit dtype relative to float32; 1 for other dtypes."""
        speed = {torch.bfloat16: self.bfloat16, torch.float16: self.float16}.get(dtype)
        return 1.0 if speed is None else max(self.float32, self.onednn if self.onednn_pays else 0.0) / speed

    def pays(self, dtype: torch.dtype) -> bool:
        """Return True if a dtype is no slower than float32, up to noise."""
        return self.slowdown(dtype) < 1.2


@functools.cache
def product_speeds() -> ProductSpeeds:
    """Measure products of 1,400 x 128 by 128 x 128 (0.1 s), or read an earlier result from ``~/.cache/torchrl_gn``."""
    key = "\n".join([processor_name(), instruction_sets(), torch.__version__, *restrictions()])
    name = f"products-{hashlib.sha256(key.encode()).hexdigest()[:12]}.json"
    with contextlib.suppress(ValueError, TypeError):  # missing, damaged, or of another version
        return ProductSpeeds(**json.loads(read_cached(name) or b""))
    speeds = _measure()
    write_cached(name, json.dumps(asdict(speeds), indent=2).encode())
    return speeds


def processor_name() -> str:
    """Return the processor's model, such as ``"AMD EPYC"``."""
    return _cpuinfo().get("model name") or platform.processor() or platform.machine()


def processor_flags() -> str:
    """Return the processor's feature flags as the system lists them, separated by spaces; empty if it does not."""
    return _cpuinfo().get("flags") or _cpuinfo().get("Features") or ""


def instruction_sets() -> str:
    """Return the processor's vector and matrix instruction sets, such as ``"AVX2, FMA"``."""
    flags = set(processor_flags().split())
    known = {"avx2": "AVX2", "fma": "FMA", "avx512f": "AVX-512", "avx512_bf16": "AVX-512 BF16"}
    known |= {"avx512_fp16": "AVX-512 FP16", "amx_tile": "AMX", "amx_bf16": "AMX BF16"}
    known |= {"asimd": "NEON", "sve": "SVE", "bf16": "BF16"}
    return ", ".join(name for flag, name in known.items() if flag in flags) or "not known"


def restrictions() -> list[str]:
    """Return the environment variables that restrict instruction sets, as ``NAME=VALUE``."""
    return [f"{name}={os.environ[name]}" for name in _LIMITS if os.environ.get(name)]


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.cache
def _cpuinfo() -> dict[str, str]:
    try:
        first = Path("/proc/cpuinfo").read_text().split("\n\n")[0]
    except OSError:
        return {}
    return {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in first.splitlines())}


def onednn_precision():
    """Return torch's settings object that has oneDNN's ``fp32_precision``; None before torch 2.9."""
    settings = getattr(torch.backends.mkldnn, "matmul", None)
    return settings if torch.backends.mkldnn.is_available() and hasattr(settings, "fp32_precision") else None


@torch.no_grad()
def _measure() -> ProductSpeeds:
    generator = torch.Generator().manual_seed(0)
    exact = [torch.randn(size, _SIZE, generator=generator, dtype=torch.float64) for size in (_ROWS, _SIZE)]
    dtypes = {"float64": torch.float64, "float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
    factors = {name: [factor.to(dtype) for factor in exact] for name, dtype in dtypes.items()}
    precision, threads = onednn_precision(), torch.get_num_threads()
    seconds = dict.fromkeys(factors, float("inf"))
    onednn, error = float("inf"), 0.0
    torch.set_num_threads(1)
    try:
        # Take turns under the same load; the first round warms up.
        for _ in range(_ROUNDS):
            for name, pair in factors.items():
                seconds[name] = min(seconds[name], _seconds(pair)[0])
            if precision is not None:
                before, precision.fp32_precision = precision.fp32_precision, "bf16"
                try:
                    took, product = _seconds(factors["float32"])
                finally:
                    precision.fp32_precision = before
                onednn, truth = min(onednn, took), exact[0] @ exact[1]
                error = float((product - truth).norm() / truth.norm())
    finally:
        torch.set_num_threads(threads)
    speeds = {name: _FLOP / took / 1e9 for name, took in seconds.items()}
    return ProductSpeeds(**speeds, onednn=_FLOP / onednn / 1e9, onednn_error=error)


def _seconds(factors: list[Tensor]) -> tuple[float, Tensor]:
    start = time.perf_counter()
    product = factors[0] @ factors[1]
    return time.perf_counter() - start, product
