"""Compile CUDA source for a GPU at run time, and launch it on torch's current stream."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_gn.cache import read_cached, write_cached

THREADS = 128
"""Threads per block; the generated sources depend on it."""


class NoCudaCompilerError(RuntimeError):
    """CUDA's run-time compiler is missing or failed; the message is one line."""


class Kernel:
    """A kernel of one source, compiled at its first launch and kept in ``~/.cache/torchrl_gn``."""

    def __init__(self, name: str, source: str) -> None:
        self.name, self.source = name, source

    def __call__(self, count: int, *arguments: int | Tensor) -> None:
        """Launch ``count`` threads; integers are passed as ``long long``, tensors as pointers.

        The tensors must be contiguous and on one GPU.
        """
        device = next(each.device for each in arguments if isinstance(each, Tensor))
        function = _function(self.name, self.source, device.index)
        values = [
            ctypes.c_void_p(each.data_ptr()) if isinstance(each, Tensor) else ctypes.c_longlong(each)
            for each in arguments
        ]
        places = (ctypes.c_void_p * len(values))(*(ctypes.addressof(each) for each in values))
        stream = ctypes.c_void_p(torch.cuda.current_stream(device).cuda_stream)
        blocks = -(-count // THREADS)
        _check(_driver().cuLaunchKernel(function, blocks, 1, 1, THREADS, 1, 1, 0, stream, places, None))


def compile_together(kernels: Sequence[Kernel], device: torch.device) -> None:
    """Compile kernels for a GPU, on all cores."""
    with ThreadPoolExecutor(len(kernels)) as pool:
        list(pool.map(lambda kernel: _binary(kernel.name, kernel.source, device.index), kernels))


@functools.lru_cache(maxsize=256)
def _function(name: str, source: str, device: int) -> ctypes.c_void_p:
    with torch.cuda.device(device):
        torch.zeros((), device="cuda")  # makes torch's context the current one
        code, module, function = _binary(name, source, device), ctypes.c_void_p(), ctypes.c_void_p()
        driver = _driver()
        _check(driver.cuModuleLoadData(ctypes.byref(module), code))
        _check(driver.cuModuleGetFunction(ctypes.byref(function), module, name.encode()))
    return function


@functools.lru_cache(maxsize=256)
def _binary(name: str, source: str, device: int) -> bytes:
    """Return the machine code of a source, from the cache or compiled."""
    major, minor = torch.cuda.get_device_capability(device)
    target = f"--gpu-architecture=sm_{major}{minor}"
    digest = hashlib.sha256("\n".join((source, target, "-O1", str(torch.version.cuda))).encode()).hexdigest()[:24]
    file = f"{name}-{digest}.cubin"
    content = read_cached(file) or b""
    if hashlib.sha256(content[:-32]).digest() == content[-32:]:
        return content[:-32]
    code = compile_source(name, source, target)
    write_cached(file, code + hashlib.sha256(code).digest())
    return code


def compile_source(name: str, source: str, target: str) -> bytes:
    """Compile for a target such as ``--gpu-architecture=sm_90``; NoCudaCompilerError if the compiler fails."""
    nvrtc, program = _compiler(), ctypes.c_void_p()
    nvrtc.nvrtcCreateProgram(ctypes.byref(program), source.encode(), f"{name}.cu".encode(), 0, None, None)
    # Above -O1 the assembler plans for many threads with 32 registers each, and spills four times as much.
    options = [target.encode(), b"--std=c++17", b"--ptxas-options=-O1"]
    failed = nvrtc.nvrtcCompileProgram(program, len(options), (ctypes.c_char_p * len(options))(*options))
    size = ctypes.c_size_t()
    try:
        if failed:
            nvrtc.nvrtcGetProgramLogSize(program, ctypes.byref(size))
            log = ctypes.create_string_buffer(size.value)
            nvrtc.nvrtcGetProgramLog(program, log)
            first = next((line for line in log.value.decode().splitlines() if "error" in line), log.value.decode())
            raise NoCudaCompilerError(f"CUDA's run-time compiler failed: {first.strip()}")
        nvrtc.nvrtcGetCUBINSize(program, ctypes.byref(size))
        code = ctypes.create_string_buffer(size.value)
        nvrtc.nvrtcGetCUBIN(program, code)
        return code.raw
    finally:
        nvrtc.nvrtcDestroyProgram(ctypes.byref(program))


def check_compiler() -> None:
    """Raise NoCudaCompilerError without CUDA's run-time compiler, as with builds of PyTorch for other GPUs."""
    _compiler()


def _check(error: int) -> None:
    if error:
        text = ctypes.c_char_p()
        _driver().cuGetErrorString(error, ctypes.byref(text))
        raise RuntimeError(f"CUDA: {(text.value or b'unknown error').decode()} ({error}).")


@functools.cache
def _driver() -> Any:
    return ctypes.CDLL("libcuda.so.1")


@functools.cache
def _compiler() -> Any:
    """Return the NVRTC library: from torch's CUDA build, or else from the system."""
    major = (torch.version.cuda or "0").split(".")[0]
    packages = Path(torch.__file__).parent.parent / "nvidia"
    names = [f"libnvrtc.so.{major}", *map(str, sorted(packages.glob(f"*/lib/libnvrtc.so.{major}*"))), "libnvrtc.so"]
    for name in names:
        with contextlib.suppress(OSError):
            return ctypes.CDLL(name)
    raise NoCudaCompilerError(
        f"libnvrtc.so.{major}, CUDA's run-time compiler, is not there: pip install nvidia-cuda-nvrtc"
    )
