"""A run's numbers in one wide file."""

from __future__ import annotations

import csv
import os
import warnings
from collections.abc import Mapping
from pathlib import Path

from torchrl_gn.atomic import atomic_path, naming_full_disk


class CsvLog:
    """Write ``path``: a row for each step, ``step`` and a column for each name, empty where nothing was logged.

    A file that is there goes on; its rows of the same or later steps are replaced by the first row that is logged. Rows
    that a full disk or a power cut left damaged are left out, with a warning.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._names, self._rows = path, ["step"], []
        damaged = 0
        if path.exists():
            self._names, self._rows, damaged = _read(path)
        if damaged:
            warnings.warn(f"{path}: {damaged} damaged rows are left out.", stacklevel=2)
            self._rewrite()
        self._resumed = bool(self._rows)

    def log(self, numbers: Mapping[str, float], step: int) -> None:
        """Add numbers to the row of a step; a new name adds a column."""
        if self._resumed:
            self._resumed, self._rows = False, [row for row in self._rows if int(row["step"]) < step]
            self._rewrite()
        new = [name for name in numbers if name not in self._names]
        same = bool(self._rows) and self._rows[-1]["step"] == str(step)
        if not same:
            self._rows.append({"step": str(step)})
        self._rows[-1] |= {name: repr(float(value)) for name, value in numbers.items()}
        self._names += new
        if new or same:
            self._rewrite()
            return
        whole = self.path.stat().st_size
        with naming_full_disk(self.path):
            try:
                with self.path.open("a", newline="") as file:
                    csv.DictWriter(file, self._names).writerow(self._rows[-1])
            except OSError:
                os.truncate(self.path, whole)  # no half row
                raise

    def _rewrite(self) -> None:
        with atomic_path(self.path) as temporary, temporary.open("w", newline="") as file:
            writer = csv.DictWriter(file, self._names)
            writer.writeheader()
            writer.writerows(self._rows)


def _read(path: Path) -> tuple[list[str], list[dict[str, str]], int]:
    """Names, whole rows, and the number of others; a last row without its line's end is cut."""
    text = path.read_bytes().decode(errors="replace")
    *whole, cut = text.splitlines(keepends=True) or [""]
    lines = [*whole, cut] if cut.endswith("\n") else whole
    names = next(csv.reader(lines[:1]), [])
    if names[:1] != ["step"] or len(set(names)) < len(names) or "\0" in lines[0]:
        return ["step"], [], len(lines) + (not cut.endswith("\n") and bool(cut))
    fields = [[] if "\0" in line else next(csv.reader([line]), []) for line in lines[1:]]
    rows = [dict(zip(names, each, strict=True)) for each in fields if _is_whole(each, len(names))]
    return names, rows, len(fields) - len(rows) + (not cut.endswith("\n") and bool(cut))


def _is_whole(fields: list[str], count: int) -> bool:
    try:
        int(fields[0])
        [float(each) for each in fields if each]
    except (ValueError, IndexError):
        return False
    return len(fields) == count
