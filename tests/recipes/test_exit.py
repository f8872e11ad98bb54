"""Recipes end with the exit code and the words that their user needs."""

from __future__ import annotations

import errno
import os
import signal
import time

import pytest

from _common.command_line import clean_exit
from torchrl_gn.training import RunFolder
from torchrl_gn.training.checkpoint import CheckpointError


def ending(error: BaseException):
    @clean_exit
    def main() -> None:
        raise error

    return main


@pytest.mark.parametrize(
    "error",
    [
        ValueError("bad lr"),
        CheckpointError("bad lr"),
        FileNotFoundError("bad lr"),
        FloatingPointError("bad lr"),
    ],
)
def test_what_a_user_can_mend_is_one_line(error, capsys):
    with pytest.raises(SystemExit) as caught:
        ending(error)()
    assert caught.value.code == 1
    assert capsys.readouterr().err == f"{type(error).__name__}: bad lr\n"


def test_a_full_disk_says_what_is_kept_and_where(tmp_path, capsys):
    run = RunFolder(tmp_path / "here", "train")
    run.data.mkdir()
    with pytest.raises(SystemExit) as caught:
        ending(OSError(errno.ENOSPC, "the disk is full"))()
    assert caught.value.code == 1
    said = capsys.readouterr().err
    assert said.startswith("OSError: [Errno 28] the disk is full; progress is saved in ") and said.count("\n") == 1


@pytest.mark.parametrize("saved", [False, True])
def test_interruptions_say_what_is_kept_and_where(saved, tmp_path, capsys):
    run = RunFolder(tmp_path / "here", "train")
    run.write_config("a: 1\n")
    if saved:
        run.data.mkdir()
    with pytest.raises(SystemExit) as caught:
        ending(KeyboardInterrupt())()
    assert caught.value.code == 130
    said = capsys.readouterr().err
    assert said == (
        f"Interrupted; progress is saved in {run.path}; resume with run_dir={run.path}.\n"
        if saved
        else "Interrupted; nothing was kept.\n"
    )


def test_being_told_to_end_is_an_interruption(capsys):
    saved = []

    @clean_exit
    def main() -> None:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(5)
        except KeyboardInterrupt:
            saved.append(True)
            raise

    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 143 and saved
    assert capsys.readouterr().err.startswith("Interrupted; ")
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize("error", [RuntimeError("bug"), TypeError("bug"), AssertionError("bug")])
def test_bugs_keep_their_traceback(error):
    with pytest.raises(type(error), match="bug"):
        ending(error)()


def test_success_returns_the_result_and_keeps_the_name():
    @clean_exit
    def main(value: int) -> int:
        """Recipe."""
        return value

    assert main(3) == 3
    assert (main.__name__, main.__doc__) == ("main", "Recipe.")


@pytest.mark.parametrize("error", [RuntimeError("no kernel"), NotImplementedError("no kernel"), RecursionError()])
def test_what_is_a_bug_keeps_its_traceback(error):
    with pytest.raises(type(error)):
        ending(error)()
