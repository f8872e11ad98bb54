"""Recipes end with the exit code and the words that their user needs."""

from __future__ import annotations

import pytest

from torchrl_gn.training.checkpoint import CheckpointError
from torchrl_gn.training.exit import clean_exit


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


def test_interruptions_say_that_the_run_is_saved(capsys):
    with pytest.raises(SystemExit) as caught:
        ending(KeyboardInterrupt())()
    assert caught.value.code == 130
    assert "saved" in capsys.readouterr().err


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
