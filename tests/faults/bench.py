"""Strike runs, fill their disk, start them twice and damage their files; resume; and compare with whole runs."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_gn.training.run_folder import CONFIG_FILE, LOCK_FILE

from ..copies import OUTSIDE
from .cases import CASES, PREPARATION, PREPARED, Case, differences, numbers_of
from .damage import damage
from .server import FOLDER, Ended, Server, Strike

SIGNALS = (signal.SIGKILL, signal.SIGINT, signal.SIGTERM)
FULL = "full disk"  # as the name of a strike
_LEAST = 32_768  # bytes of a limit on files: more than the log of a run has, which the same limit holds for


@dataclass(frozen=True)
class Whole:
    """Uninterrupted run of a recipe, with which struck runs are compared."""

    place: Path
    ended: Ended
    numbers: dict[str, Any]

    @property
    def files(self) -> list[Path]:
        """Files of the run folder, but for locks."""
        found = sorted(path for path in (self.place / FOLDER).rglob("*") if path.is_file())
        return [path.relative_to(self.place) for path in found if not path.name.endswith(LOCK_FILE)]


class Bench:
    """Runs in a folder; each method returns a fault, or nothing."""

    def __init__(self, server: Server, folder: Path) -> None:
        self.server, self.folder = server, folder
        self.processor = 0.0  # seconds
        self._whole: dict[str, Whole] = {}
        self._count = 0

    def whole(self, name: str) -> Whole:
        """A whole run of a case, with a second process that is refused while it goes on."""
        if name not in self._whole:
            place = self.folder / name
            running = self._start(CASES[name], place)
            running.until((place / FOLDER / CONFIG_FILE).exists)
            goes_on = running.goes_on
            running.send(signal.SIGSTOP)  # not to end before the second one looks
            second = self._run(CASES[name], place)
            running.send(signal.SIGCONT)
            ended = self._counted(running.end())
            wrong = [] if ended.code == 0 else [f"it ends with {ended.code}: {ended.said[-800:]}"]
            wrong += _traceback(ended)
            if goes_on and not (second.code == 1 and "is in use by another process; wait for" in second.said):
                wrong.append(f"a second process ends with {second.code}: {second.said[-800:]}")
            if wrong:
                raise AssertionError(f"{name}: {'; '.join(wrong)}")
            self._whole[name] = Whole(place, ended, numbers_of(place))
        return self._whole[name]

    def strike(self, name: str, strikes: Sequence[Strike | int]) -> list[str]:
        """Strike a run again and again, then let it end; a number is the bytes that a file may have."""
        case, whole, place, wrong = CASES[name], self.whole(name), self._place(name), []
        for each in strikes:
            given = {"largest_file": each} if isinstance(each, int) else {"strike": each}
            ended = self._run(case, place, **given)
            wrong += [f"{each}: {what}" for what in _strike_wrong(each, ended)]
        return wrong + self._resumed(case, place, whole)

    def fill(self, name: str, share: float) -> list[str]:
        """Run on a disk that takes a share of the whole run, then on one with room. Needs leave to mount."""
        case, whole, place = CASES[name], self.whole(name), self._place(name)
        size = sum((whole.place / file).stat().st_size for file in whole.files)
        with disk(place / FOLDER, int(share * size)):
            wrong = [f"{FULL}: {what}" for what in _full_wrong(self._run(case, place))]
            enlarge(place / FOLDER)
            wrong += self._resumed(case, place, whole)
        return wrong

    def damaged(self, name: str, file: Path, how: str, draw: random.Random) -> tuple[str, list[str]]:
        """Damage a file of a finished run and resume it; "refused", "read", or "as it was", and what went wrong."""
        case, whole, place = CASES[name], self.whole(name), self._place(name)
        shutil.copytree(whole.place / FOLDER, place / FOLDER)
        if not damage(place / file, how, draw):
            shutil.rmtree(place)
            return "as it was", []
        damaged = _content(place / file)
        ended = self._run(case, place)
        if ended.code == 0:
            # Nothing says what a log's numbers were, and some files no later run reads: they stay as they are.
            stays = file.suffix == ".csv" or _content(place / file) == damaged
            left = self._differences(place, whole, without=file if stays else None)
            wrong = [f"other numbers: {left[:5]}"] if left else []
        else:
            logs = "".join(log.read_text(errors="replace") for log in (place / FOLDER).rglob("log.txt"))
            named = file.name in ended.said or file.name in logs or file.parent.name in ended.said
            wrong = [] if ended.code == 1 else [f"it ends with {ended.code}: {ended.said[-800:]}"]
            wrong += [] if named else [f"not named: {ended.said[-800:]}"]
        wrong += _traceback(ended)
        if not wrong:
            shutil.rmtree(place)
        return ("refused" if ended.code else "read"), wrong

    def _resumed(self, case: Case, place: Path, whole: Whole) -> list[str]:
        ended = self._run(case, place)
        if ended.code:
            return [f"lost: it ends with {ended.code}: {ended.said[-800:]}"]
        wrong = [f"different: {found[:8]}"] if (found := self._differences(place, whole)) else []
        if not wrong and not os.path.ismount(place / FOLDER):
            shutil.rmtree(place)
        return wrong + _traceback(ended)

    def _differences(self, place: Path, whole: Whole, *, without: Path | None = None) -> list[str]:
        if without is not None:
            shutil.rmtree(place / without, ignore_errors=True)
            (place / without).unlink(missing_ok=True)
        found = differences(whole.numbers, numbers_of(place))
        own = "" if without is None else without.relative_to(FOLDER).as_posix()
        return [name for name in found if name.partition(": ")[0] != own]

    def _place(self, name: str) -> Path:
        self._count += 1
        return self.folder / f"{name}.{self._count}"

    def _options(self, case: Case) -> list[str]:
        prepared = self.folder / PREPARED
        if any(PREPARED in option for option in case.options) and not prepared.exists():
            ended = self._run(PREPARATION, prepared)
            assert ended.code == 0, ended.said
        return [option.replace(PREPARED, str(prepared)) for option in case.options]

    def _start(self, case: Case, place: Path, **more: Any):
        return self.server.start(case.recipe, self._options(case), place, settings=case.settings, **more)

    def _run(self, case: Case, place: Path, **more: Any) -> Ended:
        options = self._options(case)
        return self._counted(self.server.run(case.recipe, options, place, settings=case.settings, **more))

    def _counted(self, ended: Ended) -> Ended:
        self.processor += ended.processor
        return ended


def _content(path: Path) -> bytes | None:
    """Content of a file; None if there is none."""
    return path.read_bytes() if path.is_file() else None


def _traceback(ended: Ended) -> list[str]:
    return [f"a traceback: {ended.said[-1500:]}"] if "Traceback" in ended.said else []


def _strike_wrong(strike: Strike | int, ended: Ended) -> list[str]:
    """Fault in the end of a run that was struck."""
    if isinstance(strike, int):
        return _full_wrong(ended)
    number = int(strike.number)
    if strike.number == signal.SIGKILL:
        return [] if ended.code in (-number, 0) else [f"it ends with {ended.code}: {ended.said[-800:]}"]
    # Before the recipe listens, SIGTERM ends the process.
    if ended.code == 0 or ended.code == -signal.SIGTERM == -number or OUTSIDE in ended.said:
        return _traceback(ended)
    wrong = [] if ended.code == 128 + number else [f"it ends with {ended.code}: {ended.said[-800:]}"]
    wrong += [] if ended.said.count("Interrupted; ") == 1 else [f"it says {ended.said[-800:]}"]
    return wrong + _traceback(ended)


def _full_wrong(ended: Ended) -> list[str]:
    if ended.code == 0:
        return _traceback(ended)
    words = ("make room", "free some space", "No space", "File too large", "runs failed")
    told = any("Error: " in line and any(word in line for word in words) for line in ended.said.splitlines())
    wrong = [] if ended.code == 1 and told else [f"it ends with {ended.code}: {ended.said[-800:]}"]
    return wrong + _traceback(ended)


def draw_strike(
    draw: random.Random, whole: Whole, kind: signal.Signals | str, *, early: float = 1.0, timed: float = 0.3
) -> Strike | int:
    """Draw the moment of a strike, in the first share ``early`` of a run; or the bytes that files may have.

    ``timed``: share of moments that are times, which no seed repeats.
    """
    if isinstance(kind, str):
        largest = max((whole.place / file).stat().st_size for file in whole.files)
        return draw.randrange(_LEAST, max(largest, _LEAST + 1))
    if draw.random() < timed:
        return Strike(kind, after=draw.uniform(0, early * whole.ended.seconds))
    return Strike(kind, at=1 + int(early * draw.random() * whole.ended.operations))


@contextmanager
def disk(folder: Path, size: int) -> Iterator[None]:
    """Mount a disk of so many bytes in memory."""
    folder.mkdir(parents=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def enlarge(folder: Path) -> None:
    """Make room on a disk in memory."""
    subprocess.run(["mount", "-o", "remount,size=1g", str(folder)], check=True)


def can_mount(folder: Path) -> bool:
    """Whether this process may mount a disk in memory."""
    if os.geteuid() or shutil.which("mount") is None:
        return False
    try:
        with disk(folder / "disk", 4096):
            return True
    except subprocess.CalledProcessError:
        return False
