"""Run recipes in copies of a process that has imported everything, see ``tests/copies.py``, and strike them.

A process forks for each order, a line of JSON, and answers with the copy's id; for ``{"wait": id}`` with its exit code.
The content of pictures, which takes longer than all else, is not drawn.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..copies import RECIPES, import_all, load, run

ROOT = RECIPES.parent
FOLDER = "run"  # of a run, in the working folder of its process
_OPERATIONS = ("open", "os.rename", "os.remove", "os.mkdir")  # audit events of files; open is of reading, too


@dataclass(frozen=True)
class Strike:
    """A signal to a run.

    Attributes:
        number: of the signal.
        at: before this file operation in the run folder, counted from 1.
        after: or so many seconds after the beginning.
    """

    number: signal.Signals
    at: int | None = None
    after: float | None = None

    def __str__(self) -> str:
        return f"{self.number.name} " + (f"at file operation {self.at}" if self.at else f"after {self.after:.3f} s")


@dataclass(frozen=True)
class Ended:
    """End of a run: its exit code, output, seconds and number of file operations (0 if it was killed)."""

    code: int
    said: str
    seconds: float
    processor: float  # seconds of that, also of processes that it started
    operations: int


class Running:
    """A run in a process of its own."""

    def __init__(self, server: Server, place: Path, number: int) -> None:
        self._server, self.place, self.number, self._start = server, place, number, time.monotonic()
        self._handle = os.pidfd_open(number)

    @property
    def goes_on(self) -> bool:
        return not select.select([self._handle], [], [], 0)[0]

    def send(self, number: signal.Signals) -> None:
        """Send a signal; a process that has ended is still there until :meth:`end` asks for its exit code."""
        os.kill(self.number, number)

    def until(self, happened: Callable[[], bool]) -> None:
        """Wait for something, or for the end of the run."""
        while self.goes_on and not happened():
            time.sleep(0.001)

    def end(self, timeout: float = 300) -> Ended:
        """Wait for the end, and kill processes that do not end."""
        if late := not select.select([self._handle], [], [], timeout)[0]:
            self.send(signal.SIGKILL)
        os.close(self._handle)
        code, processor = self._server.ask({"wait": self.number})
        seconds = time.monotonic() - self._start
        log, count = self.place / f"log.{self.number}", self.place / f"operations.{self.number}"
        operations = int(count.read_text()) if count.exists() else 0
        said = log.read_text(errors="replace") + f"\nstill there after {timeout} s" * late
        return Ended(int(code), said, seconds, processor, operations)


class Server:
    """The process that is copied."""

    def __init__(self) -> None:
        command = [sys.executable, "-m", "tests.faults.server"]
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        # One thread, as copies of a process have no other; nothing here starts one.
        environment = os.environ | {"OMP_NUM_THREADS": "1", "WANDB_MODE": "offline"}
        paths = filter(None, (str(ROOT), str(RECIPES), os.environ.get("PYTHONPATH")))
        self._process = subprocess.Popen(command, env=environment | {"PYTHONPATH": os.pathsep.join(paths)}, **pipes)

    def ask(self, order: dict[str, Any]) -> list[float]:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(order) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def start(
        self,
        recipe: str,
        options: Sequence[str],
        place: Path,
        *,
        strike: Strike | None = None,
        largest_file: int | None = None,
        settings: dict[str, Any] | None = None,
    ) -> Running:
        """Start a recipe in the working folder ``place``, with ``run_dir=run`` there.

        Args:
            strike: strike at a file operation; one after some time is ignored.
            largest_file: largest size of a file, bytes; beyond it, the disk is full.
            settings: constants of the recipe's module.
        """
        place.mkdir(parents=True, exist_ok=True)
        order: dict[str, Any] = {"recipe": recipe, "options": [*options, f"run_dir={FOLDER}"], "place": str(place)}
        order |= {"largest_file": largest_file, "settings": settings or {}}
        if strike is not None and strike.at is not None:
            order["strike"] = [int(strike.number), strike.at]
        return Running(self, place, int(self.ask(order)[0]))

    def run(self, recipe: str, options: Sequence[str], place: Path, **more: Any) -> Ended:
        """Start a recipe (:meth:`start`) and wait for its end; a strike may come after some time."""
        running, strike = self.start(recipe, options, place, **more), more.get("strike")
        if strike is not None and strike.after is not None:
            select.select([running._handle], [], [], strike.after)
            running.send(strike.number)
        return running.end()

    def close(self) -> None:
        self._process.communicate(timeout=60)


@contextlib.contextmanager
def serving() -> Iterator[Server]:
    server = Server()
    try:
        yield server
    finally:
        server.close()


def _watch_operations(order: dict[str, Any]) -> Callable[[], int]:
    """Count file operations in the run folder, and strike before one of them; return the count."""
    folder, own, count = str(Path(order["place"], FOLDER)) + os.sep, os.getpid(), 0
    number, at = order.get("strike", (0, 0))

    def watch(event: str, arguments: tuple) -> None:
        nonlocal count
        if event in _OPERATIONS and isinstance(arguments[0], (str, bytes, os.PathLike)) and os.getpid() == own:
            if os.path.abspath(os.fsdecode(arguments[0])).startswith(folder):
                count += 1
                if count == at:
                    os.kill(own, number)

    sys.addaudithook(watch)
    return lambda: count


def _run(order: dict[str, Any]) -> None:
    """Be a recipe that was ordered, and end."""
    os.chdir(order["place"])
    log = os.open(f"log.{os.getpid()}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(log, 1)
    os.dup2(log, 2)
    if (limit := order["largest_file"]) is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
    for name, value in order["settings"].items():
        setattr(load(order["recipe"]), name, value)
    operations = _watch_operations(order)
    code = run(order["recipe"], order["options"])
    with contextlib.suppress(OSError):
        Path(f"operations.{os.getpid()}").write_text(str(operations()))
    os._exit(code)


def _prepare() -> None:
    """Import all recipes, and replace slow parts without influence on the results."""
    import_all()
    from matplotlib.figure import Figure

    from torchrl_gn.evaluation import video

    Figure.savefig = lambda self, file, **options: Path(file).write_bytes(b"figure" * 1000)  # type: ignore
    video._write_gif = lambda path, frames, seconds: path.write_bytes(b"video" * 1000)  # type: ignore


def _serve() -> None:
    """Fork for each line of the standard input."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of the terminal; copies listen
    _prepare()
    for line in sys.stdin:
        order = json.loads(line)
        if "wait" in order:
            _, status, used = os.wait4(order["wait"], 0)
            answer = [os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime]
        elif not (answer := [os.fork()])[0]:
            _run(order)
        answers.write(f"{json.dumps(answer)}\n")
        answers.flush()


if __name__ == "__main__":
    _serve()
