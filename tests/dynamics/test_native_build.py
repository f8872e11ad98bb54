"""How the native executor's code is built, kept and found again."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from torchrl_gn.dynamics import specialize
from torchrl_gn.dynamics.executors.native import build, operators

from .native import ROOT, equal, pull, with_compiler

pytestmark = with_compiler

CONTENT = b"a library" * 1000
WHOLE = CONTENT + hashlib.sha256(CONTENT).digest()


def load(opened=Path, **sources) -> Path:
    """A library of one source, by its path."""
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
    """Files of libraries that are built: good ones, of no code."""
    built: list[Path] = []

    def build_it(what, compiler, sources, link, file: Path) -> None:
        built.append(file)
        file.write_bytes(WHOLE)

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
def test_without_a_compiler_it_runs_by_torch(fresh, wide, inputs, monkeypatch, variables, message):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    bound = wide("pendulum")
    predictor, eager = (specialize(bound, executor=executor) for executor in ("native", "eager"))
    reason = predictor.reason
    assert reason is not None and message in reason and "\n" not in reason
    assert f"native, but here by torch: {reason}" in str(predictor).splitlines()[0]
    state, actions = inputs(predictor, 3)
    assert equal(pull(predictor, state, actions), pull(eager, state, actions))
    monkeypatch.setattr(operators, "load", lambda *_: pytest.fail("tried again"))
    predictor.refresh(bound)
    many = actions[:1, :1].expand(600, 3, -1)  # so many that C++ would pay
    torch.testing.assert_close(
        bound.rollout(state[:1].expand(600, -1, -1), many)[0][0], bound.rollout(state[0], many[0])[0]
    )


def test_a_library_is_built_once(fresh, builds):
    first = load()
    assert load() == first == builds[0] and len(builds) == 1
    assert fresh in builds[0].parents
    assert load(**{"engine.cpp": ["-O2"]}) != first and len(builds) == 2  # for each set of options


@pytest.mark.parametrize("damage", ["empty", "short", "half", "zeros", "longer"])
def test_a_damaged_library_is_built_again(fresh, builds, damage):
    load()
    damaged = {
        "empty": b"",
        "short": WHOLE[:20],
        "half": WHOLE[: len(WHOLE) // 2],
        "zeros": WHOLE[:-4096] + bytes(4096),
        "longer": WHOLE + b"x",
    }[damage]
    builds[0].write_bytes(damaged)
    assert load().read_bytes() == WHOLE
    assert builds == [builds[0]] * 2


def test_what_an_interrupted_build_leaves_is_neither_loaded_nor_kept(fresh, monkeypatch, builds):
    def interrupted(what, compiler, sources, link, file: Path) -> None:
        file.with_name(f".{file.stem}.0123abcd.so").write_bytes(b"half")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(build, "_build", interrupted)
        with pytest.raises(KeyboardInterrupt):
            load()
    assert len(list(fresh.glob("*.so"))) == 1
    load()
    assert len(builds) == 1 and list(fresh.glob("*.so")) == builds


def test_a_folder_that_cannot_be_written_to(fresh, builds, monkeypatch):
    for variables in ({"XDG_CACHE_HOME": "/proc/no"}, {"XDG_CACHE_HOME": "", "HOME": "/proc/no"}):
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
        assert load(Path.read_bytes) == WHOLE
        assert not builds.pop().exists()

    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", homeless)
    assert load(Path.read_bytes) == WHOLE


def test_a_folder_whose_code_may_not_be_run(fresh, builds):
    def opened(file: Path) -> Path:
        if fresh in file.parents:
            raise OSError("failed to map segment from shared object")
        return file

    assert load(opened) == builds[1] and fresh in builds[0].parents


def test_a_library_in_a_folder_that_is_read_only_is_used(fresh, builds, monkeypatch):
    load()
    monkeypatch.setattr(Path, "mkdir", lambda *_, **__: pytest.fail("written"))
    load()
    assert len(builds) == 1


def test_a_compiler_with_arguments(fresh, monkeypatch):
    commands = []

    def run_it(command) -> str:
        commands.append(list(command))
        if "-shared" in command:
            Path(command[-1]).write_bytes(b"linked")
        return "a version"

    monkeypatch.setattr(build, "_run", run_it)
    monkeypatch.setattr(torch.ops, "load_library", lambda path: None)
    monkeypatch.setenv("CXX", "env 'A B=c d' g++ -DX")
    monkeypatch.setenv("TORCHRL_GN_CXXFLAGS", "-DNAME='a b' -O0")
    operators.load_operators()
    version, *compiles, links = commands
    assert all(each[:4] == ["env", "A B=c d", "g++", "-DX"] for each in commands) and version[4:] == ["--version"]
    assert {Path(each[4]).name for each in compiles} == {"engine.cpp", "operators.cpp"}
    for each in (*compiles, links):
        assert each.index("-DNAME=a b") == each.index("-O0") - 1
    for each in compiles:  # after all others: the last of several counts
        others = [index for index, option in enumerate(each) if option.startswith(("-O", "-m", "-f"))]
        assert each.index("-O0") == max(others)
    (file,) = fresh.glob("*.so")
    assert file.read_bytes() == b"linked" + hashlib.sha256(b"linked").digest()


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
