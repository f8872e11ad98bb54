"""Programs that a recipe runs: they end with it, however it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

from _common import parent

SLEEPS = "import os, time; print(os.getpid(), file=open('pid', 'w'), flush=True); time.sleep(60)"
ALONE = f"import sys; sys.path[:0] = [{os.path.dirname(parent.__file__)!r}]\n"  # without the imports of recipes
ENDS = "from parent import end_with_parent; end_with_parent()\n"


def test_what_a_child_says_and_how_it_ends():
    script = "import sys; print('a' * 200_000); print('b', file=sys.stderr); sys.exit(3)"
    done = parent.run_child([sys.executable, "-c", script], env={**os.environ, "A": "B"})
    assert (done.returncode, done.stdout, done.stderr) == (3, "a" * 200_000 + "\n", "b\n")


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
@pytest.mark.parametrize("kind", ["recipe", "module"])
def test_a_child_ends_with_what_runs_it(tmp_path, ends, number, kind):
    (tmp_path / "sleeper.py").write_text(SLEEPS if kind == "module" else ALONE + ENDS + SLEEPS)
    inner = [sys.executable, "sleeper.py"] if kind == "recipe" else [sys.executable, parent.__file__, "sleeper"]
    # Shells let what they start in the background ignore Ctrl-C, and so would its children.
    outer = ALONE + "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    outer += f"from parent import run_child; run_child({inner!r})"
    with subprocess.Popen([sys.executable, "-c", outer], cwd=tmp_path, stderr=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + 60
        while not (tmp_path / "pid").exists() or not (text := (tmp_path / "pid").read_text()):
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.02)
        process.send_signal(number)
    assert ends(int(text), deadline - time.monotonic())
    assert process.returncode == -number
