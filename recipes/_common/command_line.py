"""A recipe as a program: its `--help`, exit codes and one-line error messages."""

from __future__ import annotations

import functools
import inspect
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import ParamSpec, TypeVar

from _common.options import check_options, unknown_options
from _common.parent import end_with_parent
from torchrl_gn.atomic import NO_SPACE
from torchrl_gn.training import RunFolder

P = ParamSpec("P")
R = TypeVar("R")


def clean_exit(main: Callable[P, R]) -> Callable[P, R]:
    """Check the options of a recipe's main function by :func:`check_options`, and make it exit cleanly.

    Errors that a user can fix (a bad option, file or data set, an unstable simulation) print one line to standard error
    and exit with code 1. Ctrl-C exits with 130 and SIGTERM with 143, after the recipe has saved its progress and
    printed where; the same happens if the recipe that started this one ends. All other errors are bugs and keep their
    traceback, as do torch's RuntimeErrors. At the end, run folders are unlocked.
    """

    @functools.wraps(main)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        in_main = threading.current_thread() is threading.main_thread()
        before = signal.signal(signal.SIGTERM, _interrupt) if in_main else None
        try:
            end_with_parent()
            for options in args:
                if isinstance(options, Mapping):
                    check_options(options, Path(inspect.getfile(inspect.unwrap(main))))
            return main(*args, **kwargs)
        except KeyboardInterrupt as interrupt:
            sys.stderr.write(f"Interrupted; {RunFolder.what_is_kept()}\n")
            raise SystemExit(128 + (interrupt.args[0] if interrupt.args else signal.SIGINT)) from None
        except (ValueError, OSError, RuntimeError, FloatingPointError, ImportError) as error:
            if type(error) in (RuntimeError, NotImplementedError, RecursionError):
                raise
            full = isinstance(error, OSError) and error.errno in NO_SPACE
            note = f"; {RunFolder.what_is_kept()}" if full else ""
            sys.stderr.write(f"{type(error).__name__}: {error}{note}\n")
            raise SystemExit(1) from error
        finally:
            RunFolder.release()
            if in_main:
                signal.signal(signal.SIGTERM, before)

    return wrapped


def _interrupt(number: int, _) -> None:
    raise KeyboardInterrupt(number)


def with_help(main: Callable[P, R]) -> Callable[P, R | None]:
    """Make `--help` print a recipe's docstring and commented options, and suggest names for mistyped options.

    Put it above ``@hydra.main``, whose own help has neither. It reads the options from ``config/<recipe>.yaml`` beside
    the recipe, and from the file of each group in its defaults (``config/task/swimmer6.yaml``) or on the command line.
    """

    @functools.wraps(main)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R | None:
        recipe = Path(inspect.getfile(inspect.unwrap(main)))
        if not {"--help", "-h"} & set(sys.argv[1:]):
            try:
                return main(*args, **kwargs)
            except SystemExit as end:
                for hint in unknown_options(sys.argv[1:], recipe) if end.code == 1 else ():
                    sys.stderr.write(f"{hint}\n")
                raise
        description = (sys.modules[main.__module__].__doc__ or "").strip()
        text = (recipe.parent / "config" / f"{recipe.stem}.yaml").read_text()
        sys.stdout.write(
            "\n".join([f"{description}\n", commented_options(text), *_groups(text, recipe.parent / "config")])
        )

    return wrapped


def commented_options(text: str) -> str:
    """Return the text of an options file without Hydra's own settings."""
    text = re.sub(r"^hydra:.*\n(?:[ \t]+.*\n?)*", "", text, flags=re.MULTILINE)
    text = re.sub(r"^ *- (?:_self_|override hydra/).*\n?", "", text, flags=re.MULTILINE)
    text = re.sub(r"^defaults:[^\n]*\n(?![ \t]*- )", "", text, flags=re.MULTILINE)
    return re.sub(r"\n{3,}", "\n\n", text).strip() + "\n"


def _groups(text: str, folder: Path) -> Iterator[str]:
    """Yield the texts of the groups' files, chosen by the defaults or on the command line."""
    chosen = dict(word.split("=", 1) for word in sys.argv[1:] if "=" in word)
    for group, default in re.findall(r"^ *- (\w+): (\w+)", text, flags=re.MULTILINE):
        name = chosen.get(group, default)
        if not (file := folder / group / f"{name}.yaml").exists():
            others = sorted(path.stem for path in (folder / group).glob("*.yaml"))
            raise SystemExit(f"{group}={name} is not known; use one of {others}.")
        text, marker = file.read_text(), "# @package _global_\n"
        named = "" if text.startswith(marker) else f", named {group}.<option>"
        yield f"What {group}={name} sets{named}:\n\n{text.removeprefix(marker)}"
