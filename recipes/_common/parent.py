"""Recipes and other programs that a recipe starts end with it, however it ends.

    python parent.py MODULE ...

is ``python -m MODULE ...`` that does so, of a module that knows nothing of it.
"""

from __future__ import annotations

import os
import runpy
import signal
import subprocess
import sys
from collections.abc import Sequence
from tempfile import TemporaryFile
from threading import Thread
from typing import IO, Any, cast

_VARIABLE = "TORCHRL_GN_ENDS_WITH_STDIN"


def start_child(command: Sequence[str], **options: Any) -> subprocess.Popen:
    """Start a recipe that ends when this process does: its standard input is a pipe, which then closes.

    ``options`` are of ``subprocess.Popen``.
    """
    environment = (options.pop("env", None) or os.environ) | {_VARIABLE: "1"}
    return subprocess.Popen(command, stdin=subprocess.PIPE, env=environment, **options)


def run_child(command: Sequence[str], **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a recipe, or another program that calls :func:`end_with_parent`, to its end; return code and output.

    It ends when this process does, and is stopped by an interrupt of this one. ``options`` are of ``subprocess.Popen``.
    """
    with TemporaryFile("w+") as output, TemporaryFile("w+") as errors:  # pipes would fill
        # In a session of its own, so that Ctrl-C reaches it once, from here.
        process = start_child(command, stdout=output, stderr=errors, start_new_session=True, **options)
        try:
            process.wait()
        finally:
            process.terminate()
            process.wait()
            cast(IO, process.stdin).close()
        for file in (output, errors):
            file.seek(0)
        return subprocess.CompletedProcess(command, process.returncode, output.read(), errors.read())


def end_with_parent() -> None:
    """In a process of :func:`start_child`, raise SIGTERM when the other end of the pipe closes; else do nothing."""
    if os.environ.pop(_VARIABLE, None) is not None:  # not for its own children
        Thread(target=_watch, daemon=True).start()


def _watch() -> None:
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    del sys.argv[0]
    sys.path[0] = ""  # as of python -m
    end_with_parent()
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
