"""Runs side by side: done ones are kept, failed ones told, the best found."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from threading import Thread

import pytest

from _common import sweeps
from _common.sweeps import RECIPES, Run, best, folder_name, refuse_changes, run_all
from torchrl_gn.training.run_folder import lock_folder

RECIPE = """
import json, pathlib, sys
options = dict(option.split("=", 1) for option in sys.argv[1:])
print("value", options["value"])
folder = pathlib.Path(options["run_dir"])
(folder / "times").open("a").write("x")
(folder / "metrics.json").write_text(json.dumps({"error": json.loads(options["value"])}))
"""


@pytest.fixture
def make_run(tmp_path):
    recipe = tmp_path / "recipe.py"
    recipe.write_text(RECIPE)

    def make(value: str) -> Run:
        return Run(recipe, tmp_path / folder_name(f"value {value}"), (f"value={value}",), f"value {value}")

    return make


@pytest.mark.parametrize("jobs", [2, pytest.param("local", marks=pytest.mark.slow)])
def test_each_runs_once_and_failures_do_not_stop_the_others(make_run, capsys, jobs):
    if jobs == "local":
        pytest.importorskip("ray")
    runs = [make_run(value) for value in ("3", "oops", "1", "null", "2", "3")]
    assert run_all(runs, jobs) == [runs[1]]
    assert "failed: value oops; see" in capsys.readouterr().out
    assert "JSONDecodeError" in (runs[1].folder / "log.txt").read_text()
    assert runs[1].metrics is None and runs[2].metrics == {"error": 1}
    assert run_all([runs[0], *runs[2:]], jobs) == []
    assert (runs[0].folder / "times").read_text() == "x"
    assert [run.name for run in best(runs, "error", 3)] == ["value 1", "value 2", "value 3"]
    assert best(runs, "error", 9)[-1] == runs[3]  # without a number: it diverged


def test_a_finished_run_with_other_options_is_no_result(make_run):
    run = make_run("1")
    assert run_all([run], 1) == []
    other = replace(run, overrides=("value=1", "minutes=10", "threads=2"))
    with pytest.raises(ValueError, match="holds a finished run with none of these, not minutes=10. Name a new run_dir"):
        run_all([other], 1)
    assert run_all([replace(run, overrides=("value=1", "threads=2"))], 1) == []
    (run.folder / "metrics.json").unlink()  # not finished: it goes on, if the recipe lets it
    assert run_all([other], 1) == [] and run.metrics == {"error": 1}
    with pytest.raises(ValueError, match="with minutes=10, not none of these"):
        run_all([run], 1)


def test_folder_names_are_safe():
    assert folder_name("noise 0.3 %, [a,b]") == "noise_0.3_%_a_b"
    assert json.dumps(folder_name("x")) and Path(folder_name("no skip")).name == "no_skip"


SLEEPER = """
import pathlib, signal, sys, time
def ended(*_):
    (folder / "ended").touch()
    sys.exit(143)
signal.signal(signal.SIGTERM, ended)
folder = pathlib.Path(sys.argv[1].split("=", 1)[1])
(folder / "resumed").touch()
time.sleep(300)
"""


@pytest.mark.parametrize("jobs", [2, pytest.param("local", marks=pytest.mark.slow)])
def test_an_interrupt_ends_the_runs(tmp_path, jobs):
    if jobs == "local":
        pytest.importorskip("ray")
    recipe = tmp_path / "sleeper.py"
    recipe.write_text(SLEEPER)
    run = Run(recipe, tmp_path / "run", (), "asleep")

    # Where pytest runs in the background, as in CI, its shell may have had it ignore Ctrl-C.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)

    def interrupt() -> None:
        while not (run.folder / "resumed").exists():
            time.sleep(0.1)
        os.kill(os.getpid(), signal.SIGINT)

    Thread(target=interrupt, daemon=True).start()
    try:
        with pytest.raises(KeyboardInterrupt):
            run_all([run], jobs)
    finally:
        signal.signal(signal.SIGINT, before)
    assert (run.folder / "ended").exists()


SAVER = """
import pathlib, sys, time
sys.path.append({recipes!r})
from _common import clean_exit
from torchrl_gn.training import RunFolder
@clean_exit
def main():
    run = RunFolder(pathlib.Path(sys.argv[1].split("=", 1)[1]), "saver")
    try:
        run.file("begun").write_text(run.file("begun").read_text() + "x" if run.file("begun").exists() else "x")
        while not run.file("saved").exists():
            time.sleep(0.1)
        run.write_metrics({{}}, seed=0)
    except KeyboardInterrupt:
        time.sleep(2)
        run.file("saved").touch()
        raise
main()
"""
SWEEP = """
import sys
sys.path.append({recipes!r})
from pathlib import Path
from _common.sweeps import Run, run_all
print(len(run_all([Run(Path(sys.argv[1]), Path(sys.argv[2]), (), "saving")], 1)))
"""


@pytest.mark.slow
def test_runs_end_with_a_sweep_that_is_killed_and_the_next_waits_for_their_end(tmp_path):
    (tmp_path / "saver.py").write_text(SAVER.format(recipes=str(RECIPES)))
    (tmp_path / "sweep.py").write_text(SWEEP.format(recipes=str(RECIPES)))
    folder = tmp_path / "run"
    command = [sys.executable, *(str(tmp_path / name) for name in ("sweep.py", "saver.py", "run"))]
    with subprocess.Popen(command) as killed:
        while not (folder / "begun").exists():
            time.sleep(0.1)
            assert killed.poll() is None
        killed.kill()
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.stdout == "0\n", done.stderr
    assert "Interrupted; progress is saved in" in (folder / "log.txt").read_text()
    assert (folder / "begun").read_text() == "xx" and (folder / "metrics.json").exists()


def test_a_run_that_another_process_is_at_fails(make_run, monkeypatch):
    run = make_run("1")
    run.folder.mkdir()
    monkeypatch.setattr(sweeps, "LAST_SAVE", 0.1)
    lock = lock_folder(run.folder)
    assert lock is not None and run_all([run], 1) == [run]
    assert (
        "is in use by another process" in (run.folder / "log.txt").read_text() and not (run.folder / "times").exists()
    )
    lock.release()
    assert run_all([run], 1) == []


def test_numbers_of_a_run_say_what_diverged(make_run):
    runs = {value: make_run(value) for value in ("3", "null")}
    assert runs["3"].numbers() == {}
    run_all(runs.values(), 1)
    assert runs["3"].numbers() == {"error": 3.0}
    assert runs["null"].numbers() == {"error": math.inf} and runs["null"].numbers(-1.0) == {"error": -1.0}


def test_a_finished_run_goes_on_where_it_may(make_run):
    run = replace(make_run("1"), goes_on=("minutes",))
    refuse_changes([run])
    run_all([run], 1)
    longer = replace(run, overrides=("value=1", "minutes=9"))
    assert run_all([longer], 1) == [] and (run.folder / "times").read_text() == "xx" and longer.is_done()
    assert run_all([longer], 1) == [] and (run.folder / "times").read_text() == "xx"
    with pytest.raises(ValueError, match="with value=1, not value=2"):
        refuse_changes([replace(longer, overrides=("value=2", "minutes=9"))])
    failing = replace(longer, overrides=("value=oops", "minutes=9"), goes_on=("value",))
    assert run_all([failing], 1) == [failing] and failing.metrics is None  # and not what others had measured
