"""Child processes of recipes; each ends when its parent process ends, even if the parent is killed.

    python parent.py MODULE ...

runs ``python -m MODULE ...`` as such a child, for a module that does not call :func:`end_with_parent` itself.
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

    ``options`` go to ``subprocess.Popen``.
    """
    environment = (options.pop("env", None) or os.environ) | {_VARIABLE: "1"}
    return subprocess.Popen(command, stdin=subprocess.PIPE, env=environment, **options)


def run_child(command: Sequence[str], **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a recipe, or another program that calls :func:`end_with_parent`; return its exit code and output.

    The child ends when this process ends or is interrupted. ``options`` go to ``subprocess.Popen``.
    """
    with TemporaryFile("w+") as output, TemporaryFile("w+") as errors:  # pipes would fill up
        # In its own session, so that Ctrl-C reaches it only once, from this process.
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
    """Send this process SIGTERM when its parent ends, if :func:`start_child` started it; else do nothing."""
    if os.environ.pop(_VARIABLE, None) is not None:  # its own children must not inherit it
        Thread(target=_watch, daemon=True).start()


def _watch() -> None:
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    del sys.argv[0]
    sys.path[0] = ""  # as python -m does
    end_with_parent()
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
