"""``torchrl-gn view`` as a user runs it: messages, a real server until Ctrl-C, and a real browser."""

from __future__ import annotations

import contextlib
import io
import signal
import socket
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator

import pytest

from torchrl_gn.__main__ import main

from .browser import CHROMIUM, Browser

HOW = 'the viewer needs viser: pip install "torchrl_gn[view]"'
TEXT = "(document.body?.innerText ?? '')"  # of the page, as people see it
READING = f"Number(({TEXT}.match(/t = ([0-9.]+) s/) ?? [0, -1])[1])"
SECONDS = 600.0  # nothing takes as long, even on a busy machine


def refused(*arguments: str) -> str:
    """Output of a command that exits with code 2."""
    with contextlib.redirect_stderr(io.StringIO()) as said, pytest.raises(SystemExit) as ended:
        main(["view", *arguments])
    assert ended.value.code == 2
    return said.getvalue()


def test_without_viser_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)  # as if it were not installed
    assert 'pip install "torchrl_gn[view]"' in refused("pendulum")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["pendulm"], "Unknown scene 'pendulm'. Did you mean 'pendulum'?"),
        (["missing.xml"], "MJCF file not found: missing.xml"),
        (["pendulum", "--model", "nothing"], "no checkpoint at nothing"),
        (["pendulum", "--trajectory", "nothing"], "There are no trajectories at nothing"),
        (["pendulum", "--plan", "dance"], "no task 'dance' for scene 'pendulum'"),
        (["pendulum", "--policy", "nothing"], "no checkpoint at nothing"),
        (["pendulum", "--policy", "nothing", "--plan"], "Give --plan or --policy, not both"),
        (["pendulum", "--port", "eighty"], "invalid int value: 'eighty'"),
    ],
)
def test_what_cannot_be_shown_is_one_message(arguments, message):
    pytest.importorskip("viser", reason=HOW)
    assert message in refused(*arguments)


def test_a_taken_port_is_one_message():
    pytest.importorskip("viser", reason=HOW)
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        assert "Give another --port" in refused("pendulum", "--port", str(other.getsockname()[1]))


@contextlib.contextmanager
def served(*arguments: str) -> Iterator[tuple[subprocess.Popen, str]]:
    """A viewer in its own process, and its address."""
    command = [sys.executable, "-m", "torchrl_gn", "view", *arguments, "--port", "0"]
    # A shell that runs tests in the background has them ignore Ctrl-C.
    heard = {"preexec_fn": lambda: signal.signal(signal.SIGINT, signal.default_int_handler)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **heard) as process:
        watch = threading.Timer(SECONDS, process.kill)
        watch.start()
        try:
            line = process.stdout.readline()
            assert line.startswith("http://localhost:"), line + process.stderr.read()
            yield process, line.split()[0]
        finally:
            watch.cancel()
            process.kill()


def interrupt(process: subprocess.Popen) -> tuple[int, str, str]:
    """Exit code, output and errors of a process after Ctrl-C."""
    process.send_signal(signal.SIGINT)
    out, errors = process.communicate(timeout=SECONDS)
    return process.returncode, out, errors


@pytest.mark.slow
def test_it_serves_until_ctrl_c():
    pytest.importorskip("viser", reason=HOW)
    with served("pendulum") as (process, url):
        page = urllib.request.urlopen(url, timeout=SECONDS).read()
        assert b"<html" in page.lower()
        assert interrupt(process) == (0, "", "")


@pytest.mark.slow
def test_ctrl_c_ends_a_planner_at_work():
    pytest.importorskip("viser", reason=HOW)
    pytest.importorskip("websockets")
    if CHROMIUM is None:
        pytest.skip("no Chromium found: apt-get install chromium")
    with served("swimmer6", "--plan") as (process, url), Browser(seconds=SECONDS) as browser:
        browser.open(url)
        browser.until(f"{TEXT}.includes('planning') || {TEXT}.includes('reward')")
        assert interrupt(process) == (0, "", "")


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1280, 800), (390, 844)], ids=["desk", "phone"])
def test_a_browser_sees_the_robot_and_steps_it(tmp_path, size):
    """The page's readings come from the server: they show the effects of its buttons."""
    pytest.importorskip("viser", reason=HOW)
    if CHROMIUM is None:
        pytest.skip("no Chromium found: apt-get install chromium")
    from PIL import Image

    with served("cheetah") as (process, url), Browser(*size, seconds=SECONDS) as browser:
        browser.open(url)
        browser.until("document.querySelector('canvas') !== null")
        browser.until(f"{READING} > 0")
        browser.click("Pause")
        browser.click("Reset")
        browser.until(f"{READING} === 0")
        browser.click("Step")
        browser.until(f"{READING} === 0.01")
        browser.click("Step")
        browser.until(f"{READING} === 0.02")

        # The picture is drawn once the page has faded in: robot, ground and sky differ.
        def colors() -> bool:
            (tmp_path / "page.png").write_bytes(browser.picture())
            with Image.open(tmp_path / "page.png") as picture:
                canvas = picture.convert("RGB").crop((0, 0, min(900, size[0]), size[1] // 2))
                return len(canvas.getcolors(1 << 20)) > 500

        browser.until(colors)
        assert interrupt(process) == (0, "", "")
