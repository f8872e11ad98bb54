"""Build the C++ code once for this processor."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import torch
from filelock import FileLock

from torchrl_gn.atomic import atomic_path
from torchrl_gn.processor import cache_folder

L = TypeVar("L")

SOURCES = sorted(path for path in Path(__file__).parent.iterdir() if path.suffix in (".h", ".cpp"))


class NoCompilerError(FileNotFoundError):
    """There is no C++ compiler, or it failed: the message is one line."""


def find_compiler() -> list[str] | None:
    """Command of the C++ compiler: ``CXX``, which may have arguments, else c++, g++ or clang++; None without one."""
    command = shlex.split(os.environ.get("CXX", "")) or list(filter(shutil.which, ("c++", "g++", "clang++")))[:1]
    return command if command and shutil.which(command[0]) else None


def load(
    name: str,
    what: str,
    sources: Mapping[str, Sequence[str]],
    link: Sequence[str],
    parts: Sequence[str],
    opened: Callable[[Path], L],
) -> L:
    """What ``opened`` makes of the library of sources beside this file, built where none is kept.

    ``sources`` are file names with the options to compile them, ``link`` options to link, ``what`` says what is built.
    A library is kept for its sources, compiler, options and ``parts``.

    Raises:
        NoCompilerError: without a working C++ compiler.
    """
    compiler = find_compiler()
    if compiler is None:
        raise NoCompilerError("There is no C++ compiler: install g++ for the native executor.")
    version = _run([*compiler, "--version"]).splitlines()[:1]
    options = [option for each in sources.values() for option in each]
    key = [*compiler, *version, *options, *link, *parts, sys.platform]
    digest = hashlib.sha256("\n".join([*key, *(path.read_text() for path in SOURCES)]).encode())
    name = f"{name}-{digest.hexdigest()[:16]}.so"
    build = functools.partial(_build, what, compiler, sources, link)
    try:
        folder = cache_folder()
        file = folder / name
        if _is_whole(file):
            return opened(file)
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(folder / f".{name}.lock"):  # others wait for whoever builds
            if not _is_whole(file):
                for left in folder.glob(f".{file.stem}.*.so"):  # by a build that was interrupted
                    left.unlink()
                build(file)
        return opened(file)
    except NoCompilerError:
        raise
    except (OSError, RuntimeError):  # no home, or none to write to
        pass
    with tempfile.TemporaryDirectory(prefix="torchrl_gn-") as temporary:
        file = Path(temporary) / name  # code in the home may not be run, either
        build(file)
        return opened(file)


def _build(
    what: str, compiler: Sequence[str], sources: Mapping[str, Sequence[str]], link: Sequence[str], file: Path
) -> None:
    """Compile, all sources at once, to a file that ends with its SHA-256."""
    sys.stderr.write(f"Building {what} for this processor, once: about a minute.\n")
    with atomic_path(file) as temporary, tempfile.TemporaryDirectory(prefix="torchrl_gn-") as objects:
        places = {source: str(Path(objects) / f"{source}.o") for source in sources}
        with ThreadPoolExecutor(len(sources)) as pool:
            list(
                pool.map(
                    _run,
                    [
                        [*compiler, str(Path(__file__).parent / source), *options, "-c", "-o", places[source]]
                        for source, options in sources.items()
                    ],
                )
            )
        _run([*compiler, *places.values(), "-shared", "-pthread", *link, "-o", str(temporary)])
        with temporary.open("ab") as out:
            out.write(hashlib.sha256(temporary.read_bytes()).digest())


def _is_whole(file: Path) -> bool:
    """Whether a library is there, and not damaged, which could end the process."""
    with contextlib.suppress(OSError):
        content = file.read_bytes()
        return hashlib.sha256(content[:-32]).digest() == content[-32:]
    return False


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
