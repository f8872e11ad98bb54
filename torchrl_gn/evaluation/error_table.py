"""Prediction errors of one model on one test set, as numbers and as a table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from torchrl_gn.evaluation.calibration import Coverage


@dataclass(frozen=True)
class PredictionError:
    """One error (one-step, or rollout over a horizon) and its components."""

    name: str
    components: dict[str, float]  # relative to the persistence baseline; infinite if a prediction diverged
    squared: dict[str, float]  # mean squared errors: m^2, rad^2, (m/s)^2, (rad/s)^2
    baselines: dict[str, float]  # mean squared errors of the persistence baseline
    left_out: tuple[str, ...]  # components that are fixed, or never move in the truth
    sequences: int
    diverged: int  # sequences with a prediction that is not a valid state or far outside the training range

    @property
    def total(self) -> float:
        """Mean of the components' relative errors."""
        return sum(self.components.values()) / len(self.components)


@dataclass(frozen=True, eq=False)
class ErrorTable:
    """Prediction errors of one model on one test set (paper, "Prediction performance evaluation")."""

    errors: dict[str, PredictionError]
    rollouts: Tensor  # [keep, H + 1, N, 13] first predicted rollouts; NaN from where one diverged
    coverage: Coverage | None = None  # coverage of a calibrated ensemble's standard deviations

    def __getitem__(self, name: str) -> PredictionError:
        return self.errors[name]

    def to_metrics(self) -> dict[str, float]:
        """Return the numbers by name, for a logger or a JSON file.

        Every error ``E`` has ``E`` (total), ``E/<component>`` or, if left out, ``E/left_out/<component>`` = 1,
        ``E/baseline/<component>`` (mean square of the persistence baseline), and ``E/diverged`` (sequences). A
        calibrated ensemble also has the numbers of :class:`~torchrl_gn.evaluation.Coverage`, prefixed ``coverage/``.
        """
        metrics: dict[str, float] = {}
        for name, error in self.errors.items():
            metrics[name] = error.total
            metrics |= {f"{name}/{component}": value for component, value in error.components.items()}
            metrics |= {f"{name}/baseline/{component}": value for component, value in error.baselines.items()}
            metrics |= {f"{name}/left_out/{component}": 1.0 for component in error.left_out}
            metrics[f"{name}/diverged"] = float(error.diverged)
        known = {} if self.coverage is None else self.coverage.to_metrics()
        return metrics | {f"coverage/{name}": value for name, value in known.items()}

    def rows(self) -> list[tuple[str, ...]]:
        """Return the table's cells as text: rows of titles, total, components and baseline."""
        errors = self.errors.values()
        rows = [_titles(self), ("total", *(_number(error.total) for error in errors))]
        for name in next(iter(errors)).baselines:
            values = (_number(e.components[name]) if name in e.components else "left out" for e in errors)
            rows.append((name.replace("_", " "), *values))
        return [*rows, ("persistence baseline", *[_number(1.0)] * len(errors))]

    def to_table(self) -> str:
        """Return the errors relative to the persistence baseline as text, one column per error, and the coverage."""
        covered = [] if self.coverage is None else ["", str(self.coverage)]
        return "\n".join([*aligned(self.rows()), *self._divergences(), *covered])

    __str__ = to_table

    def _divergences(self) -> list[str]:
        bad = [error for error in self.errors.values() if error.diverged]
        return [f"{error.name}: {error.diverged} of {error.sequences} sequences diverged" for error in bad]


def summary(tables: Mapping[str, ErrorTable]) -> str:
    """Return the total errors of several tables, by label, as text with one row per table; all need the same errors."""
    first = next(iter(tables.values()))
    rows = [_titles(first)]
    rows += [(label, *(_number(table[name].total) for name in first.errors)) for label, table in tables.items()]
    rows.append(("persistence baseline", *(_number(1.0) for _ in first.errors)))
    notes = [f"{label}, {line}" for label, table in tables.items() for line in table._divergences()]
    return "\n".join([*aligned(rows), *notes])


def _titles(table: ErrorTable) -> tuple[str, ...]:
    return "relative squared error", *(name.replace("_error", "").replace("_", " ") for name in table.errors)


def aligned(rows: list[tuple[str, ...]]) -> list[str]:
    """Return the lines of a table, with its title row underlined and its numbers right-aligned."""
    first, *widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join((row[0].ljust(first), *map(str.rjust, row[1:], widths))) for row in rows]
    return [lines[0], "-" * len(lines[0]), *lines[1:]]


def _number(value: float) -> str:
    return f"{value:.3f}" if 0.1 <= value < 1000 or value == 0 else f"{value:.2e}"
