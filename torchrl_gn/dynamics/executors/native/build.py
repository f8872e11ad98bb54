"""Build the C++ code once for this processor."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import torch
from filelock import FileLock, Timeout

from torchrl_gn.cache import SharedCacheError, cache_folder, make_private, open_private, warn_of, write_private

L = TypeVar("L")

SOURCES = sorted(path for path in Path(__file__).parent.iterdir() if path.suffix in (".h", ".cpp"))
_LIMIT = 1800.0  # seconds for a library, waiting for other processes included; two cores build it in one minute
_ANSWER = 30.0  # seconds for a compiler to say its version


class NoCompilerError(FileNotFoundError):
    """There is no C++ compiler, or it failed; the message is one line."""


def find_compiler() -> list[str] | None:
    """Return the command of the C++ compiler: ``CXX`` with its arguments, else c++, g++ or clang++; or None."""
    command = shlex.split(os.environ.get("CXX", "")) or list(filter(shutil.which, ("c++", "g++", "clang++")))[:1]
    return command if command and shutil.which(command[0]) else None


def compiler_version(compiler: Sequence[str]) -> str:
    """Return the first line that ``--version`` prints; NoCompilerError if it fails."""
    (version,) = _run([[*compiler, "--version"]], time.monotonic() + _ANSWER)
    return version.partition("\n")[0]


def load(
    name: str,
    what: str,
    sources: Mapping[str, Sequence[str]],
    link: Sequence[str],
    parts: Sequence[str],
    opened: Callable[[Path], L],
) -> L:
    """Open a library built from sources beside this file; build it if the cache has none.

    Args:
        name: prefix of the library's file name.
        what: description of the library for messages.
        sources: file names with the options to compile them.
        link: options to link.
        parts: text to add to the cache key, which contains sources, compiler and options.
        opened: function that opens the library's file; ``load`` returns its result.

    Raises:
        NoCompilerError: if there is no C++ compiler, or it fails or takes over thirty minutes. The latter two are also
            written to stderr.
    """
    compiler = find_compiler()
    if compiler is None:
        raise NoCompilerError("There is no C++ compiler: install g++ for the native executor.")
    try:
        return _load(name, what, compiler, sources, link, parts, opened)
    except NoCompilerError as error:
        sys.stderr.write(f"{error} PyTorch runs instead.\n")
        raise


def _load(
    name: str,
    what: str,
    compiler: Sequence[str],
    sources: Mapping[str, Sequence[str]],
    link: Sequence[str],
    parts: Sequence[str],
    opened: Callable[[Path], L],
) -> L:
    deadline = time.monotonic() + _LIMIT
    options = [option for each in sources.values() for option in each]
    key = [*compiler, compiler_version(compiler), *options, *link, *parts, sys.platform]
    digest = hashlib.sha256("\n".join([*key, *(path.read_text() for path in SOURCES)]).encode())
    name = f"{name}-{digest.hexdigest()[:16]}.so"
    build = functools.cache(functools.partial(_build, what, compiler, sources, link, deadline))
    try:
        file = cache_folder() / name
        if (library := _checked_library(file)) is None:
            make_private(file.parent)
            # Other processes wait for the one that builds.
            with FileLock(file.with_name(f".{name}.lock"), timeout=max(0.0, deadline - time.monotonic())):
                if (library := _checked_library(file)) is None:
                    for left in file.parent.glob(f".{file.stem}.*.so"):  # left by an interrupted build
                        left.unlink()
                    write_private(file, build())
                    library = _checked_library(file)
        if library is not None:
            return opened(library)
    except NoCompilerError:
        raise
    except Timeout:
        raise NoCompilerError(f"Another process has been building {what} for {_LIMIT:.0f} s: stop it.") from None
    except SharedCacheError as error:
        warn_of(error)
    except (OSError, RuntimeError):  # no home folder, or a read-only one
        pass
    with tempfile.TemporaryDirectory(prefix="torchrl_gn-") as temporary:
        file = Path(temporary) / name  # the home folder may also forbid running code
        write_private(file, build())
        if (library := _checked_library(file)) is None:
            raise OSError(f"{file} was changed while it was made: choose another folder by TMPDIR.")
        return opened(library)


def _build(
    what: str,
    compiler: Sequence[str],
    sources: Mapping[str, Sequence[str]],
    link: Sequence[str],
    deadline: float,
) -> bytes:
    """Compile all sources in parallel; return the library followed by its SHA-256."""
    sys.stderr.write(f"Building {what} for this processor, once: about a minute.\n")
    with tempfile.TemporaryDirectory(prefix="torchrl_gn-") as objects:
        places = {source: str(Path(objects) / f"{source}.o") for source in sources}
        library = Path(objects) / "library.so"
        compiles = [
            [*compiler, str(Path(__file__).parent / source), *options, "-c", "-o", places[source]]
            for source, options in sources.items()
        ]
        _run(compiles, deadline)
        _run([[*compiler, *places.values(), "-shared", "-pthread", *link, "-o", str(library)]], deadline)
        content = library.read_bytes()
        return content + hashlib.sha256(content).digest()


def _checked_library(file: Path) -> Path | None:
    """Return a path to load a cached library from; None if it is damaged or another user may have written it.

    The path names an open descriptor, so that the loaded library is the checked one. The descriptor stays open: if
    another library got the same path, the system's loader would take it for this one.
    """
    try:
        descriptor = open_private(file)
    except OSError:
        return None
    with open(descriptor, "rb", closefd=False) as content:
        whole = content.read()
    if hashlib.sha256(whole[:-32]).digest() == whole[-32:]:  # loading a damaged library could crash the process
        return Path(f"/proc/self/fd/{descriptor}")
    os.close(descriptor)
    return None


def instruction_flags() -> list[str]:
    """Return compiler flags for the instructions that torch uses; ``ATEN_CPU_CAPABILITY`` restricts them."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return []
    sets = {"AVX512": ["-march=native"], "AVX2": ["-mavx2", "-mfma"]}
    return sets.get(torch.backends.cpu.get_cpu_capability(), [])


# Runs a command and kills its session once standard input closes, as happens when the process that started it ends.
_WATCHED = """
exec 3<&0 </dev/null
(read -r line <&3; kill -9 0) & watch=$!
"$@" 3<&-; code=$?
kill -9 $watch
exit $code
"""


def _run(commands: Sequence[Sequence[str]], deadline: float) -> list[str]:
    """Run commands in parallel and return their output; the deadline, a failure or an interrupt kills all."""
    begin, running = time.monotonic(), []
    with contextlib.ExitStack() as stack:
        for command in commands:
            files = [stack.enter_context(tempfile.TemporaryFile("w+", errors="replace")) for _ in range(2)]
            try:
                # A session per command, as compilers start processes that outlive them.
                process = subprocess.Popen(
                    ["sh", "-c", _WATCHED, "sh", *command],
                    stdin=subprocess.PIPE,
                    stdout=files[0],
                    stderr=files[1],
                    start_new_session=True,
                )
            except OSError as error:
                raise _failure(command, str(error)) from error
            stack.callback(_kill, process)
            running.append((command, process, *files))
        for command, process, _, errors in running:
            try:
                code = process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                seconds = time.monotonic() - begin
                raise NoCompilerError(
                    f"The C++ compiler {command[0]} was stopped after {seconds:.0f} s: choose another by CXX."
                ) from None
            if code:
                errors.seek(0)
                raise _failure(command, errors.read() or f"it ended with code {code}")
        for _, _, output, _ in running:
            output.seek(0)
        return [output.read() for _, _, output, _ in running]


def _kill(process: subprocess.Popen) -> None:
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    if process.stdin is not None:
        process.stdin.close()


def _failure(command: Sequence[str], text: str) -> NoCompilerError:
    lines = text.splitlines()
    first = next((line for line in lines if "error" in line), "".join(lines[-1:]))
    return NoCompilerError(f"The C++ compiler {command[0]} failed: {first.strip()}")
