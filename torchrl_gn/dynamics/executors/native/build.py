"""Build the C++ code once for this processor."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import torch
from filelock import FileLock

from torchrl_gn.atomic import atomic_path
from torchrl_gn.processor import cache_folder, processor_flags, processor_name

SOURCES = sorted(path for path in Path(__file__).parent.iterdir() if path.suffix in (".h", ".cpp"))
_OPTIONS = ("-std=c++17", "-O3", "-fPIC", "-shared", "-ffp-contract=fast", "-fno-math-errno", "-pthread")


class NoCompilerError(FileNotFoundError):
    """There is no C++ compiler, or it failed: the message is one line."""


def find_compiler() -> list[str] | None:
    """Command of the C++ compiler: ``CXX``, which may have arguments, else c++, g++ or clang++; None without one."""
    command = shlex.split(os.environ.get("CXX", "")) or list(filter(shutil.which, ("c++", "g++", "clang++")))[:1]
    return command if command and shutil.which(command[0]) else None


def load_code() -> ctypes.CDLL:
    """The compiled code, built at the first use on a processor and kept in ``~/.cache/torchrl_gn`` (20 s).

    Raises:
        NoCompilerError: without a working C++ compiler (``CXX``, which may have arguments, else c++, g++ or clang++).
    """
    found = _library_or_reason()
    if isinstance(found, str):
        raise NoCompilerError(found)
    return found


@functools.cache
def _library_or_reason() -> ctypes.CDLL | str:
    try:
        return _load()
    except (OSError, ValueError) as error:
        return str(error)


def _load() -> ctypes.CDLL:
    compiler = find_compiler()
    if compiler is None:
        raise NoCompilerError("There is no C++ compiler: install g++ for the native executor.")
    options = [*_OPTIONS, *instruction_flags(), *shlex.split(os.environ.get("TORCHRL_GN_CXXFLAGS", ""))]
    version = _run([*compiler, "--version"]).splitlines()[:1]
    parts = [*compiler, *version, *options, processor_name(), processor_flags(), sys.platform]
    digest = hashlib.sha256("\n".join([*parts, *(path.read_text() for path in SOURCES)]).encode())
    name, command = f"native-{digest.hexdigest()[:16]}.so", [*compiler, *options]
    try:
        folder = cache_folder()
        file = folder / name
        if (library := _opened(file)) is not None:
            return library
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(folder / f".{name}.lock"):  # others wait for whoever builds
            if (library := _opened(file)) is None:
                for left in folder.glob(f".{file.stem}.*.so"):  # by a build that was interrupted
                    left.unlink()
                _build(command, file)
                library = _opened(file)
        if library is not None:
            return library
    except NoCompilerError:
        raise
    except (OSError, RuntimeError):  # no home, or none to write to
        pass
    with tempfile.TemporaryDirectory(prefix="torchrl_gn-") as temporary:
        file = Path(temporary) / name  # code in the home may not be run, either
        _build(command, file)
        return ctypes.CDLL(str(file))


def _build(command: Sequence[str], file: Path) -> None:
    """Compile to a file that ends with its SHA-256."""
    sys.stderr.write("Building the native executor for this processor, once: about 20 s.\n")
    source = next(path for path in SOURCES if path.suffix == ".cpp")
    with atomic_path(file) as temporary:
        _run([*command, str(source), "-o", str(temporary)])
        with temporary.open("ab") as out:
            out.write(hashlib.sha256(temporary.read_bytes()).digest())


def _opened(file: Path) -> ctypes.CDLL | None:
    """The library of a whole file; None if it is missing or damaged, which could end the process."""
    with contextlib.suppress(OSError):
        content = file.read_bytes()
        if hashlib.sha256(content[:-32]).digest() == content[-32:]:
            return ctypes.CDLL(str(file))
    return None


def instruction_flags() -> list[str]:
    """Compiler flags for what torch uses of this processor, which ``ATEN_CPU_CAPABILITY`` restricts."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return []
    sets = {"AVX512": ["-march=native"], "AVX2": ["-mavx2", "-mfma"]}
    return sets.get(torch.backends.cpu.get_cpu_capability(), [])


def _run(command: Sequence[str]) -> str:
    try:
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout
    except (OSError, subprocess.CalledProcessError) as error:
        lines = (getattr(error, "stderr", "") or str(error)).splitlines()
        first = next((line for line in lines if "error" in line), "".join(lines[-1:]))
        raise NoCompilerError(f"The C++ compiler {command[0]} failed: {first.strip()}") from error
