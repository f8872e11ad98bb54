"""Exit codes and one-line error messages of recipes."""

from __future__ import annotations

import functools
import inspect
import signal
import sys
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import ParamSpec, TypeVar

from _common.options import check_options
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
            kept = f"; {RunFolder.what_is_kept()}" if full else ""
            sys.stderr.write(f"{type(error).__name__}: {error}{kept}\n")
            raise SystemExit(1) from error
        finally:
            RunFolder.release()
            if in_main:
                signal.signal(signal.SIGTERM, before)

    return wrapped


def _interrupt(number: int, _) -> None:
    raise KeyboardInterrupt(number)
