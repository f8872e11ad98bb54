"""Log of a run's numbers in one wide csv file."""

from __future__ import annotations

import csv
import os
import warnings
from collections.abc import Mapping
from pathlib import Path

from torchrl_gn.atomic import atomic_path, naming_full_disk


class CsvLog:
    """Csv file ``path`` with a row per step, and columns ``step`` and one per name, empty where nothing was logged.

    An existing file is continued: the first new number of a name removes the name's old numbers from that step on. Rows
    that a full disk or a power cut damaged are dropped, with a warning.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._names, self._rows = path, ["step"], dict[int, dict[str, str]]()
        damaged = 0
        if path.exists():
            self._names, self._rows, damaged = _read(path)
        self._before = set(self._names[1:])  # names of the existing file that were not logged since
        if damaged:
            warnings.warn(f"{path}: {damaged} damaged rows are left out.", stacklevel=2)
            self._rewrite()

    def log(self, numbers: Mapping[str, float], step: int) -> None:
        """Add numbers to the row of a step; a new name adds a column. ValueError for the name ``step``."""
        if "step" in numbers:
            raise ValueError(f"{self.path}: the column 'step' is the number of the row; give the number another name.")
        if again := self._before & numbers.keys():
            self._before -= again
            for late in [each for each in self._rows if each >= step]:
                row = {name: value for name, value in self._rows.pop(late).items() if name not in again}
                self._rows |= {late: row} if row else {}
        new = [name for name in numbers if name not in self._names]
        rewrite = bool(again or new) or not self.path.exists() or max(self._rows, default=step - 1) >= step
        self._rows.setdefault(step, {}).update({name: repr(float(value)) for name, value in numbers.items()})
        self._names += new
        if rewrite:
            self._rewrite()
            return
        whole = self.path.stat().st_size
        with naming_full_disk(self.path):
            try:
                with self.path.open("a", newline="", encoding="utf-8") as file:
                    csv.DictWriter(file, self._names).writerow({"step": step, **self._rows[step]})
            except OSError:
                os.truncate(self.path, whole)  # remove the partial row
                raise

    def _rewrite(self) -> None:
        with atomic_path(self.path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, self._names)
            writer.writeheader()
            writer.writerows({"step": step, **self._rows[step]} for step in sorted(self._rows))


def _read(path: Path) -> tuple[list[str], dict[int, dict[str, str]], int]:
    """Read names, intact rows by step, and the number of damaged rows, such as a last one without newline."""
    text = path.read_bytes().decode(errors="replace")
    *lines, cut = text.split("\n")
    names, *fields = map(_fields, lines or [""])
    if names[:1] != ["step"] or len(set(names)) < len(names):
        return ["step"], {}, len(lines) + bool(cut)
    whole = [each for each in fields if _is_whole(each, len(names))]
    rows: dict[int, dict[str, str]] = {}
    for step, *values in whole:
        row = {name: value for name, value in zip(names[1:], values, strict=True) if value}
        rows.setdefault(int(step), {}).update(row)
    return names, rows, len(fields) - len(whole) + bool(cut)


def _fields(line: str) -> list[str]:
    """Split a line into fields; none if it has NUL or other unprintable characters."""
    line = line.removesuffix("\r")
    return next(csv.reader([line]), []) if line.isprintable() else []


def _is_whole(fields: list[str], count: int) -> bool:
    try:
        int(fields[0])
        [float(field) for field in fields if field]
    except (ValueError, IndexError):
        return False
    return len(fields) == count
