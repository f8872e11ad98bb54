"""Recipes that another one starts end with it, however it ends."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Sequence
from threading import Thread
from typing import Any

_VARIABLE = "TORCHRL_GN_ENDS_WITH_STDIN"


def start_child(command: Sequence[str], **options: Any) -> subprocess.Popen:
    """Start a recipe that ends when this process does: its standard input is a pipe, which then closes.

    ``options`` are of ``subprocess.Popen``.
    """
    return subprocess.Popen(command, stdin=subprocess.PIPE, env=os.environ | {_VARIABLE: "1"}, **options)


def end_with_parent() -> None:
    """In a process of :func:`start_child`, raise SIGTERM when the other end of the pipe closes; else do nothing."""
    if os.environ.pop(_VARIABLE, None) is not None:  # not for its own children
        Thread(target=_watch, daemon=True).start()


def _watch() -> None:
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
