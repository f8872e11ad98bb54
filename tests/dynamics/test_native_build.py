"""How the native executor's code is built, kept and found again."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import torch
from filelock import FileLock

from torchrl_gn.cache import SharedCacheWarning
from torchrl_gn.dynamics import specialize
from torchrl_gn.dynamics.executors.native import NoCompilerError, build, operators

from ..sharing import SHARED, share
from .native import ROOT, equal, vjp, with_compiler

pytestmark = with_compiler

CONTENT = b"a library" * 1000
WHOLE = CONTENT + hashlib.sha256(CONTENT).digest()


def load(opened=Path.resolve, **sources):
    """A library of one source, by default its path."""
    return build.load("name", "a thing", sources or {"engine.cpp": ["-O1"]}, [], [], opened)


@pytest.fixture
def fresh(tmp_path, monkeypatch):
    """An empty cache folder with a space in its name, and no operators known to this process."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "a cache"))
    monkeypatch.delenv("CXX", raising=False)
    operators._operators_or_reason.cache_clear()
    yield tmp_path / "a cache/torchrl_gn"
    operators._operators_or_reason.cache_clear()


@pytest.fixture
def builds(monkeypatch):
    """Deadlines of libraries that are built: good ones, of no code."""
    built: list[float] = []

    def build_it(what, compiler, sources, link, deadline) -> bytes:
        built.append(deadline)
        return WHOLE

    monkeypatch.setattr(build, "_build", build_it)
    return built


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"PATH": ""}, "There is no C++ compiler"),
        ({"CXX": "no-such-compiler"}, "There is no C++ compiler"),
        ({"CXX": sys.executable + " -c 'raise SystemExit(1)'"}, "failed"),
        ({"TORCHRL_GN_CXXFLAGS": "-no-such-option"}, "error: unrecognized"),
        ({"TORCHRL_GN_CXXFLAGS": "'"}, "No closing quotation"),
    ],
)
def test_without_a_compiler_it_runs_by_torch(fresh, wide, inputs, monkeypatch, calls, variables, message):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    bound = wide("pendulum")
    predictor, eager = (specialize(bound, executor=executor) for executor in ("native", "eager"))
    reason = predictor.reason
    assert reason is not None and message in reason and "\n" not in reason
    assert f"native, but here by torch: {reason}" in str(predictor).splitlines()[0]
    state, actions = inputs(predictor, 3)
    assert equal(vjp(predictor, state, actions), vjp(eager, state, actions))
    tried = calls(operators, "load")
    predictor.refresh(bound)
    many = actions[:1, :1].expand(600, 3, -1)  # so many that C++ would pay
    torch.testing.assert_close(
        bound.rollout(state[:1].expand(600, -1, -1), many)[0][0], bound.rollout(state[0], many[0])[0]
    )
    assert not tried


def test_a_library_is_built_once(fresh, builds):
    first = load()
    assert load() == first and first.read_bytes() == WHOLE and len(builds) == 1
    assert fresh in first.parents
    assert load(**{"engine.cpp": ["-O2"]}) != first and len(builds) == 2  # for each set of options


@pytest.mark.parametrize("damage", ["empty", "short", "half", "zeros", "longer"])
def test_a_damaged_library_is_built_again(fresh, builds, damage):
    file = load()
    damaged = {
        "empty": b"",
        "short": WHOLE[:20],
        "half": WHOLE[: len(WHOLE) // 2],
        "zeros": WHOLE[:-4096] + bytes(4096),
        "longer": WHOLE + b"x",
    }[damage]
    file.write_bytes(damaged)
    assert load() == file and file.read_bytes() == WHOLE
    assert len(builds) == 2


def test_what_an_interrupted_build_leaves_is_neither_loaded_nor_kept(fresh, builds):
    file = load()
    file.rename(file.with_name(f".{file.stem}.0123abcd.so"))
    assert load() == file
    assert len(builds) == 2 and list(fresh.glob("*.so")) == [file]


def test_a_folder_that_cannot_be_written_to(fresh, builds, monkeypatch):
    for variables in ({"XDG_CACHE_HOME": "/proc/no"}, {"XDG_CACHE_HOME": "", "HOME": "/proc/no"}):
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
        assert load(Path.read_bytes) == WHOLE
        assert not load().exists()
    monkeypatch.setenv("HOME", "~")  # as if no user had this number
    assert load(Path.read_bytes) == WHOLE


def test_a_folder_whose_code_may_not_be_run(fresh, builds):
    tried = []

    def opened(file: Path) -> bytes:
        tried.append(file.resolve())
        if fresh in tried[-1].parents:
            raise OSError("failed to map segment from shared object")
        return file.read_bytes()

    assert load(opened) == WHOLE
    assert [fresh in file.parents for file in tried] == [True, False] and len(builds) == 1


@pytest.mark.parametrize("how", SHARED)
def test_a_library_that_others_may_have_written_is_not_loaded(fresh, builds, monkeypatch, how):
    load()
    share(fresh, how, monkeypatch)
    with pytest.warns(SharedCacheWarning, match="torchrl_gn is another user's"):
        place, mode = load(lambda file: (file.resolve(), file.resolve().parent.stat().st_mode))
    assert len(builds) == 2 and fresh not in place.parents and mode & 0o777 == 0o700


@pytest.mark.parametrize("how", SHARED)
def test_a_file_that_others_may_have_written_is_replaced(fresh, builds, monkeypatch, how):
    file = load()
    share(file, how, monkeypatch)
    assert load() == file and len(builds) == 2
    assert load() == file and len(builds) == 2


def test_what_is_loaded_is_what_was_checked(fresh, builds):
    """Although another could come to its path in between."""

    def opened(file: Path) -> bytes:
        (fresh / "theirs").write_bytes(b"planted")
        (fresh / "theirs").rename(file.resolve())
        return file.read_bytes()

    assert load(opened) == WHOLE


def test_a_library_in_a_folder_that_is_read_only_is_used(fresh, builds):
    file = load()
    fresh.chmod(0o555)
    written = fresh.stat().st_mtime_ns  # root may write all the same
    assert load() == file and len(builds) == 1 and fresh.stat().st_mtime_ns == written
    fresh.chmod(0o755)


# Writes what it was called with, and the file that it is to make.
COMPILER = """#!/bin/sh
for last; do :; done
printf '%s\\n' "$A" "$@" > "FOLDER/${last##*/}.call"
[ "$last" = --version ] || printf linked > "$last"
"""


def test_a_compiler_with_arguments(fresh, tmp_path, monkeypatch):
    (tmp_path / "compiler").write_text(COMPILER.replace("FOLDER", str(tmp_path)))
    (tmp_path / "compiler").chmod(0o755)
    monkeypatch.setenv("CXX", f"env 'A=b c' {tmp_path / 'compiler'} -DX")
    monkeypatch.setenv("TORCHRL_GN_CXXFLAGS", "-DNAME='a b' -O0")
    with pytest.raises(NoCompilerError):  # it is no library
        operators.load_operators()
    commands = {file.stem: file.read_text().splitlines() for file in tmp_path.glob("*.call")}
    version, links = commands.pop("--version"), commands.pop("library.so")
    compiles = commands.values()
    assert all(each[:2] == ["b c", "-DX"] for each in (version, links, *compiles)) and version[2:] == ["--version"]
    assert {Path(each[2]).name for each in compiles} == {"engine.cpp", "operators.cpp"}
    for each in (*compiles, links):
        assert each.index("-DNAME=a b") == each.index("-O0") - 1
    for each in compiles:  # after all others: the last of several counts
        others = [index for index, option in enumerate(each) if option.startswith(("-O", "-m", "-f"))]
        assert each.index("-O0") == max(others)
    (file,) = fresh.glob("*.so")
    assert file.read_bytes() == b"linked" + hashlib.sha256(b"linked").digest()


@pytest.fixture
def hangs(tmp_path, monkeypatch):
    """Let the compiler hang; then raise an exception in the process that waits for it."""
    compiler, place, waits = tmp_path / "compiler", tmp_path / "process", []
    # As g++ does, it starts a process that holds its output.
    compiler.write_text(f'#!/bin/sh\n[ "$1" = --version ] && exit\nsleep 100 & echo $! > "{place}"; wait\n')
    compiler.chmod(0o755)
    monkeypatch.setenv("CXX", str(compiler))
    wait = subprocess.Popen.wait

    def until_it_hangs(process, timeout=None):
        if timeout is None or "--version" in process.args:
            return wait(process)
        while not (place.exists() and place.read_text().endswith("\n")):
            time.sleep(0.01)
        waits.append(timeout)
        raise error(process.args, timeout)

    def run(error_: type[BaseException]) -> tuple[BaseException, int, float]:
        """The error of loading, the number of the process that hung, and its time limit in seconds."""
        nonlocal error
        error = error_
        with pytest.raises(error if error is KeyboardInterrupt else NoCompilerError) as caught:
            load()
        return caught.value, int(place.read_text()), waits[0]

    error = BaseException
    monkeypatch.setattr(subprocess.Popen, "wait", until_it_hangs)
    return run


def test_a_compiler_that_hangs_is_stopped(fresh, hangs, capsys, ends):
    error, process, seconds = hangs(subprocess.TimeoutExpired)
    assert build._LIMIT - 60 < seconds < build._LIMIT
    assert ends(process, 5)
    assert re.fullmatch(r"The C\+\+ compiler \S+ was stopped after \d+ s: choose another by CXX\.", str(error))
    assert capsys.readouterr().err.splitlines()[1:] == [f"{error} PyTorch runs instead."]


def test_an_interrupt_stops_the_compiler(fresh, hangs, ends):
    assert ends(hangs(KeyboardInterrupt)[1], 5)


@pytest.mark.slow
def test_a_compiler_ends_with_the_process_that_started_it(tmp_path, ends):
    place = tmp_path / "process"
    command = ["sh", "-c", f"sleep 100 & echo $! > '{place}'; wait"]  # as g++ does
    code = "import time; from torchrl_gn.dynamics.executors.native import build; "
    code += f"build._run([{command}], time.monotonic() + 99)"
    running = subprocess.Popen([sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": str(ROOT)})
    while running.poll() is None and not (place.exists() and place.read_text().endswith("\n")):
        time.sleep(0.01)
    running.kill()
    running.wait()
    assert ends(int(place.read_text()), 5)


def test_a_compiler_that_hangs_at_its_version(monkeypatch):
    monkeypatch.setattr(build, "_ANSWER", 0.2)
    with pytest.raises(NoCompilerError, match="compiler sh was stopped after 0 s"):
        build.compiler_version(["sh", "-c", "sleep 100"])


def test_a_process_that_builds_for_ever_is_not_waited_for(fresh, builds, monkeypatch, capsys):
    lock = lock_of(load())
    monkeypatch.setattr(build, "_LIMIT", 0.2)
    with lock, pytest.raises(NoCompilerError, match="Another process has been building a thing for 0 s: stop it"):
        load()
    assert len(builds) == 1 and "PyTorch runs instead." in capsys.readouterr().err


def test_waiting_and_building_share_the_time(fresh, builds):
    """Whoever waited for a build that failed has the rest for his own."""
    lock, released = lock_of(load()), []

    def release() -> None:
        released.append(time.monotonic())
        lock.release()

    lock.acquire()
    timer = threading.Timer(0.2, release)
    timer.start()
    load()
    timer.join()
    assert builds[1] - build._LIMIT < released[0]


def lock_of(library: Path) -> FileLock:
    """The lock with which a library is built, which is no longer there."""
    library.unlink()
    return FileLock(library.with_name(f".{library.name}.lock"), thread_local=False)


@pytest.mark.slow
@pytest.mark.parametrize("compiler", ["g++", "clang++"])
def test_two_processes_build_at_once(tmp_path, compiler):
    if shutil.which(compiler) is None:
        pytest.skip(f"there is no {compiler}")
    folder = tmp_path / "a cache"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(folder), "CXX": f"env {compiler}"}
    environment["TORCHRL_GN_CXXFLAGS"] = "-O0"
    code = "from torchrl_gn.dynamics.executors.native.operators import load_operators as l; l().rollout, l().pack"
    command = [sys.executable, "-c", code]
    both = [subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    messages = [process.communicate()[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], messages
    assert sum("Building the native executor" in message for message in messages) == 1
    (file,) = (folder / "torchrl_gn").glob("*.so")
    content = file.read_bytes()
    assert hashlib.sha256(content[:-32]).digest() == content[-32:]
