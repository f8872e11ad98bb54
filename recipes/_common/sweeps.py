"""Run recipes side by side, each in its own process; finished runs are kept."""

from __future__ import annotations

import math
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import IO, Any, cast

from tqdm import tqdm

from _common.parent import start_child
from torchrl_gn.atomic import atomic_path, read_json, write_json
from torchrl_gn.evaluation import plot_bars
from torchrl_gn.interrupts import held, let_in_at_once
from torchrl_gn.training import RayCluster, RunFolder, Tracker
from torchrl_gn.training.run_folder import METRICS_FILE, lock_folder

RECIPES = Path(__file__).parents[1]
FORWARD_MODEL, MPC, VALUE = (RECIPES / f"{name}.py" for name in ("forward_model", "mpc", "value"))
OPTIONS_FILE = "options.json"
LAST_SAVE = 30.0  # seconds for runs of a killed sweep to save and end
MAY_DIFFER = ("threads=", "executor=", "data.folder=")  # options that may differ from a finished run's


@dataclass(frozen=True)
class Run:
    """A run of a recipe.

    Attributes:
        recipe: the recipe's file.
        folder: its run folder.
        overrides: options of the recipe.
        name: its name in messages.
        goes_on: options (``"minutes"``) that may change: a finished run then resumes instead of being refused.
    """

    recipe: Path
    folder: Path
    overrides: tuple[str, ...]
    name: str
    goes_on: tuple[str, ...] = ()

    def numbers(self, diverged: float = math.inf) -> dict[str, float]:
        """Return the numbers of ``metrics.json``, ``diverged`` for non-finite ones; empty if the run is not done."""
        found = {name: diverged if value is None else value for name, value in (self.metrics or {}).items()}
        return {name: float(value) for name, value in found.items() if isinstance(value, (int, float))}

    @property
    def metrics(self) -> dict[str, Any] | None:
        """Content of ``metrics.json``; None if the run is not done."""
        path = self.folder / METRICS_FILE
        return read_json(path) if path.exists() else None

    def is_done(self) -> bool:
        """Return True if the run has finished with these options.

        Raises:
            ValueError: if it has finished with other options; the message names those that differ.
        """
        if not (self.folder / METRICS_FILE).exists():
            return False
        if not (path := self.folder / OPTIONS_FILE).exists():
            return True
        both = read_json(path), self.overrides
        before, now = ({option for option in options if not option.startswith(MAY_DIFFER)} for options in both)
        if before == now:
            return True
        if all(option.split("=", 1)[0] in self.goes_on for option in before ^ now):
            return False
        was, wanted = (", ".join(sorted(options)) or "none of these" for options in (before - now, now - before))
        raise ValueError(f"{self.folder} holds a finished run with {was}, not {wanted}. Name a new run_dir.")


def folder_name(text: str) -> str:
    """Turn a text into a folder's name without characters that Hydra misreads (a comma makes a list)."""
    return re.sub(r"[^\w.%-]+", "_", text).strip("_")


def override(value: Any) -> str:
    """Write a value as Hydra reads it on a command line."""
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{override(each)}" for key, each in value.items()) + "}"
    if isinstance(value, str):
        return "'" + value.replace("\\", "\\\\").replace("'", "\\'") + "'"
    if isinstance(value, Sequence):
        return "[" + ",".join(map(override, value)) + "]"
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def run_all(runs: Iterable[Run], jobs: int | str, *, desc: str = "training") -> list[Run]:
    """Run all unfinished runs, several at a time, with a progress bar.

    If a run fails, its name is printed and the others continue; its output is in ``log.txt`` of its folder. The end of
    this process, by Ctrl-C or otherwise, ends all runs, which first save their progress.

    Args:
        runs: the runs; equal ones run once.
        jobs: how many at a time, or the address of a Ray cluster, which runs one on every core (``"local"``: one of
            this machine); its machines must see the same files.
        desc: text of the progress bar.

    Returns:
        The runs that failed.

    Raises:
        ValueError: if a finished run was made with other options.
    """
    runs, failed = list(dict.fromkeys(runs)), []
    left = [run for run in runs if not run.is_done()]
    if not left:
        return []  # without starting a cluster
    pool = _Threads(jobs) if isinstance(jobs, int) else _OnRay(jobs)
    progress = tqdm(total=len(runs), initial=len(runs) - len(left), desc=desc, unit="run", leave=False)
    with held(), progress as bar, pool:  # a second Ctrl-C waits until all have saved
        futures = {pool.start(run): run for run in left}
        try:
            with let_in_at_once():
                for future in as_completed(futures):
                    run = futures[future]
                    if future.result():
                        failed.append(run)
                        tqdm.write(f"failed: {run.name}; see {run.folder / 'log.txt'}")
                    bar.update()
        except KeyboardInterrupt:
            pool.stop()
            raise
    return failed


def refuse_changes(runs: Iterable[Run]) -> None:
    """Refuse finished runs with other options before anything is written; :func:`run_all` would refuse them later.

    Raises:
        ValueError: if a finished run was made with other options.
    """
    for run in runs:
        run.is_done()


def refuse_failures(failed: Sequence[Run]) -> None:
    """Raise if runs failed.

    Raises:
        ValueError: if a run failed.
    """
    if failed:
        raise ValueError(f"{len(failed)} runs failed; see their log.txt. Start again to go on.")


def report_sweep(
    folder: RunFolder,
    lines: Sequence[str],
    bars: Mapping[str, Mapping[str, Mapping[str, tuple[float, float]]]],
    metrics: Mapping[str, Any],
    failed: Sequence[Run],
    tracker: Tracker,
    *,
    seed: int,
) -> None:
    """Write, log and print the results of a sweep, and raise if runs failed.

    Args:
        folder: folder for ``table.md``, ``errors.png`` and ``metrics.json``.
        lines: the tables, in Markdown.
        bars: panels for :func:`~torchrl_gn.evaluation.plot_bars`; empty: no figure.
        metrics: flat names and plain numbers.
        failed: runs that failed.
        tracker: the log, which is closed.
        seed: the sweep's first seed.

    Raises:
        ValueError: if runs failed; all results are written first.
    """
    with atomic_path(folder.file("table.md")) as temporary:
        temporary.write_text("\n".join(lines) + "\n")
    if bars:
        plot_bars(bars, folder.file("errors.png"))
    tracker.finish(folder.write_metrics({**metrics, "failed": len(failed)}, seed=seed), folder.written)
    tqdm.write("\n".join(lines))
    for path in folder.written:
        tqdm.write(str(path))
    refuse_failures(failed)


def _start(run: Run, folder: Path) -> subprocess.Popen | None:
    """Start a run's process in a working folder, with output in ``log.txt``; None if the run folder is in use."""
    place = folder / run.folder
    place.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, str(run.recipe), f"run_dir={run.folder}", *run.overrides]
    with (place / "log.txt").open("a") as log:
        log.write(f"$ {shlex.join(command)}\n")
        log.flush()
        try:
            lock = lock_folder(place, seconds=LAST_SAVE)
        except ValueError as error:
            log.write(f"{error}\n")
            return None
        (place / METRICS_FILE).unlink(missing_ok=True)  # metrics of earlier options
        write_json(place / OPTIONS_FILE, list(run.overrides))
        if lock is not None:
            lock.release()
        # In its own session, so that Ctrl-C reaches it only once, from this process.
        return start_child(command, stdout=log, stderr=log, cwd=folder, start_new_session=True)


class _Threads(ThreadPoolExecutor):
    """Processes on this machine, with one waiting thread for each."""

    def __init__(self, jobs: int) -> None:
        super().__init__(jobs)
        self.running: set[subprocess.Popen] = set()
        self.stopped = False

    def start(self, run: Run) -> Future[int]:
        return self.submit(self._run, run)

    def _run(self, run: Run) -> int:
        if self.stopped:
            return 130
        if (process := _start(run, Path.cwd())) is None:
            return 1
        self.running.add(process)
        if self.stopped:  # since the check above
            process.terminate()
        try:
            return process.wait()
        finally:
            self.running.discard(process)
            cast(IO, process.stdin).close()

    def stop(self) -> None:
        self.stopped = True
        for process in list(self.running):
            process.terminate()
        while self.running:
            time.sleep(0.1)


class _OnRay(RayCluster):
    """Processes on the machines of a Ray cluster."""

    def start(self, run: Run) -> Future[int]:
        return self.submit(_run_and_wait, run, Path.cwd())


def _run_and_wait(run: Run, folder: Path) -> int:
    if (process := _start(run, folder)) is None:
        return 1
    try:
        while True:
            try:
                return process.wait(timeout=1)
            except subprocess.TimeoutExpired:
                pass  # Ray can interrupt only between waits
    finally:
        process.terminate()
        process.wait()
        cast(IO, process.stdin).close()


def mean_and_half_range(values: Sequence[float]) -> tuple[float, float]:
    """Return the mean of the values, and half the difference of the largest and the smallest."""
    return mean(values), (max(values) - min(values)) / 2


def best(runs: Sequence[Run], metric: str, count: int = 1) -> list[Run]:
    """Return the ``count`` finished runs with the smallest ``metric``, best first; diverged runs come last."""
    done = [(run, numbers[metric]) for run in runs if (numbers := run.numbers())]
    return [run for run, _ in sorted(done, key=lambda entry: entry[1])[:count]]
