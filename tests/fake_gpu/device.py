"""Builds and registers the device ``fakegpu``, which changes torch in the whole process."""

from __future__ import annotations

import contextlib
import hashlib
import os
import subprocess
import sys
import tempfile
import types
from collections.abc import Iterator
from pathlib import Path

import torch
from filelock import FileLock

from torchrl_gn.dynamics.executors.native.build import find_compiler

NAME = "fakegpu"
SOURCE = Path(__file__).with_name("device.cpp")


def register() -> torch.device:
    """Make the device known to torch; half a minute the first time, in which it is built."""
    torch.ops.load_library(str(_library()))
    torch.utils.rename_privateuse1_backend(NAME)
    torch.ops.fake_gpu.register()
    module = types.ModuleType(f"torch.{NAME}")
    vars(module).update(
        is_available=lambda: True,
        device_count=lambda: 2,
        current_device=lambda: 0,
        device=lambda _: contextlib.nullcontext(),
        synchronize=lambda _=None: None,
        _is_in_bad_fork=lambda: False,
        manual_seed_all=lambda _: None,  # it draws from the CPU's generator, if none is given
        get_amp_supported_dtype=lambda: [torch.bfloat16, torch.float16],
    )
    torch._register_device_module(NAME, module)
    # As modules have attributes of any name, they get none here.
    torch.utils.generate_methods_for_privateuse1_backend(for_tensor=True, for_module=False, for_storage=True)
    return torch.device(NAME, 0)


@contextlib.contextmanager
def without_waits() -> Iterator[None]:
    """Raise RuntimeError where the host would wait for the device."""
    torch.ops.fake_gpu.refuse(True)
    try:
        yield
    finally:
        torch.ops.fake_gpu.refuse(False)


def waits() -> int:
    """How often the host has waited."""
    return torch.ops.fake_gpu.waits()


def _library() -> Path:
    compiler, root = find_compiler(), Path(torch.__file__).parent
    assert compiler is not None
    options = [f"-I{root / part}" for part in ("include", "include/torch/csrc/api/include")]
    options += ["-std=c++20", "-O1", "-w", "-fPIC", "-shared", "-pthread"]
    options += [f"-D_GLIBCXX_USE_CXX11_ABI={int(torch.compiled_with_cxx11_abi())}"]
    link = [f"-L{root / 'lib'}", "-ltorch_cpu", "-lc10"]
    key = "\n".join([*compiler, *options, torch.__version__, sys.platform, SOURCE.read_text()])
    folder = Path(tempfile.gettempdir()) / f"torchrl_gn_tests_{os.getuid()}_fake_gpu"
    folder.mkdir(exist_ok=True)
    file = folder / f"device-{hashlib.sha256(key.encode()).hexdigest()[:16]}.so"
    with FileLock(file.with_suffix(".lock")):  # others wait for whoever builds
        if not file.exists():
            part = file.with_suffix(".part")
            subprocess.run([*compiler, str(SOURCE), *options, *link, "-o", str(part)], check=True)
            part.rename(file)
    return file
