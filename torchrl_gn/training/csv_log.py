"""A run's numbers in one wide file."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

from torchrl_gn.atomic import atomic_path


class CsvLog:
    """Write ``path``: a row for each step, ``step`` and a column for each name, empty where nothing was logged.

    A file that is there goes on; its rows of the same or later steps are replaced by the first row that is logged.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._names, self._rows = path, ["step"], []
        if path.exists():
            with path.open(newline="") as file:
                reader = csv.DictReader(file)
                self._rows = list(reader)
                self._names = list(reader.fieldnames or self._names)
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
        with self.path.open("a", newline="") as file:
            csv.DictWriter(file, self._names).writerow(self._rows[-1])

    def _rewrite(self) -> None:
        with atomic_path(self.path) as temporary, temporary.open("w", newline="") as file:
            writer = csv.DictWriter(file, self._names)
            writer.writeheader()
            writer.writerows(self._rows)
