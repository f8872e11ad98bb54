"""Figures of the report, drawn from the numbers in a claim's own table.

A claim's ``figure`` has these options:

- ``kind``: ``dots`` or ``bars`` along a horizontal axis, or ``lines``; or ``curves``, one panel for each task of the
  claim's learning curves (recipes/_report/curves.py) up to ``frames``, whose only other options are ``axis``,
  ``along`` and ``alt``;
- ``table`` (its index, default 0) and ``rows`` (their indices, default all);
- ``row``: a row's label, in which ``{column}`` stands for a cell; the text from ``until`` on is dropped. Or ``labels``,
  one for each row. Rows of the same label are drawn as one, with a dot each;
- ``y``: columns, by name or index, or ``{"column", "take", "spread", "name"}``: ``take`` selects the number of a cell
  to draw (an index or "all", default 0), ``spread`` is the index of its half-range in the cell, or the column of the
  half-ranges, and ``name`` is the column's name in the figure;
- ``panel``: a label like ``row``. Rows of different panels are drawn on their own axes; with ``share``, panels of lines
  share the vertical axis;
- ``between``: two columns. A number is drawn in per cent, from 0 at the first column's number to 100 at the second's;
- ``transpose``: draws columns as rows, and rows as colours;
- ``ours``: rows to draw in colour, the others grey; ``log``: a logarithmic axis; ``from``: start of the axis of the
  numbers; ``at``: a dashed line, at a number or a claim's value;
- ``axis``, ``along``: names, with units, of the axis of the numbers and of the horizontal axis of lines;
- ``alt``: the alternative text.

A figure's file keeps a digest of its options and numbers, so that a check of it needs no drawing.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from _report.curves import curve_panels
from _report.data import INDEX, Pages
from _report.pages import shown

KINDS = ("dots", "bars", "lines", "curves")
DIGEST = "Digest"  # key of the PNG's text
# Raise the number when drawing.py draws these figures differently: all of them are then drawn anew.
_DRAWING = 3  # dots, bars and lines
_CURVE_DRAWING = 1  # learning curves
_KEYS = {"kind", "table", "rows", "row", "until", "labels", "y", "panel", "between", "transpose", "ours", "log", "at"}
_KEYS |= {"from", "axis", "along", "alt", "share"}
_CURVE_KEYS = {"kind", "frames", "axis", "along", "alt"}
_NUMBER = re.compile(r"(?<![\w.])-?(?:\d{1,3}(?:,\d{3})+|\d+)(?:\.\d+)?(?:e[+-]?\d+)?", re.ASCII)

Points = dict[str, dict[str, list[tuple[float, float]]]]  # (value, half-range), by row, by series


@dataclass(frozen=True)
class ReportFigure:
    """A figure's options, and its points or curves by panel."""

    options: Mapping[str, Any]
    panels: Mapping[str, Any]

    @property
    def digest(self) -> str:
        """Digest of all that is drawn."""
        options = {key: value for key, value in self.options.items() if key != "alt"}
        drawing = _CURVE_DRAWING if options["kind"] == "curves" else _DRAWING
        text = json.dumps([drawing, options, self.panels], sort_keys=False)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def numbers(text: str) -> list[float]:
    """Return the numbers of a cell in their order; infinity for "diverges".

    >>> numbers("**42.8** (40.0 to 44.2)"), numbers("1.4e-3 / 11"), numbers("46,879, 3"), numbers("0.1-0.2")
    ([42.8, 40.0, 44.2], [0.0014, 11.0], [46879.0, 3.0], [0.1, 0.2])
    """
    text = re.sub(r"[*`]", "", text).replace("diverges", "1e999")
    return [float(match.replace(",", "")) for match in _NUMBER.findall(text)]


def read_figures(data: Pages) -> dict[str, ReportFigure]:
    """Return the figures by the names of their claims.

    Raises:
        ValueError: if a figure asks for a number that its claim's table does not hold; the message names the claim.
    """
    figures = {}
    for name in data[INDEX]["order"]:
        if "figure" in data[name]:
            try:
                figures[name] = read_figure(name, data)
            except (KeyError, IndexError, ValueError) as error:
                raise ValueError(f"{name}.json, figure: {error}") from error
    return figures


def read_figure(name: str, data: Pages) -> ReportFigure:
    """Return a claim's figure.

    Raises:
        ValueError: if an option is unknown, or a cell lacks the number that is asked for or holds one that diverged.
    """
    claim, options = data[name], data[name]["figure"]
    if options["kind"] not in KINDS:
        raise ValueError(f"kind={options['kind']!r} must be one of {KINDS}.")
    keys = _CURVE_KEYS if options["kind"] == "curves" else _KEYS
    if unknown := set(options) - keys:
        raise ValueError(f"unknown options {sorted(unknown)}; use some of {sorted(keys)}.")
    if not options["alt"] or not options["axis"]:
        raise ValueError("alt and axis must describe the figure.")
    if options["kind"] == "curves":
        return ReportFigure(options, curve_panels(claim))
    table = claim["tables"][options.get("table", 0)]
    columns = [_plain(column) for column in table["columns"]]
    rows = [[_plain(shown(cell, name, data)) for cell in row] for row in table["rows"]]
    chosen = options.get("rows", range(len(rows)))
    labels = options.get("labels") or [_label(options["row"], columns, rows[at], options) for at in chosen]
    panels: dict[str, Points] = {}
    for label, row in zip(labels, [rows[at] for at in chosen], strict=True):
        points = panels.setdefault(_label(options.get("panel", ""), columns, row), {})
        for wanted in options["y"]:
            wanted = wanted if isinstance(wanted, Mapping) else {"column": wanted}
            column = _column(wanted["column"], columns)
            found = _drawn(row[column], wanted)
            if isinstance(beside := wanted.get("spread"), str):
                found = [(value, numbers(row[_column(beside, columns)])[0]) for value, _ in found]
            if "between" in options:
                low, high = (numbers(row[_column(each, columns)])[0] for each in options["between"])
                found = [(round(100 * (value - low) / (high - low), 6), 0.0) for value, _ in found]
            keys = label, wanted.get("name", columns[column])
            outer, inner = reversed(keys) if options.get("transpose") else keys
            points.setdefault(outer, {}).setdefault(inner, []).extend(found)
    if isinstance(at := options.get("at"), str):
        options = {**options, "at": numbers(shown(claim["values"][at], name, data))[0]}
    return ReportFigure(options, panels)


def stale_figures(figures: Mapping[str, ReportFigure], folder: Path) -> list[str]:
    """Return the names of figures in ``folder`` that are missing, outdated, or of no claim."""
    there = {file.name: _digest_of(file) for file in folder.glob("*.png")}
    wanted = {f"{name}.png": figure.digest for name, figure in figures.items()}
    return sorted(name for name in there.keys() | wanted.keys() if there.get(name) != wanted.get(name, ""))


def _digest_of(file: Path) -> str | None:
    """Return the digest in a figure's file; None if there is none."""
    from PIL import Image

    with suppress(OSError), Image.open(file) as image:
        return image.info.get(DIGEST)
    return None  # not a PNG: it was damaged


def _plain(text: str) -> str:
    return re.sub(r"[*`]", "", text)


def _column(wanted: str | int, columns: Sequence[str]) -> int:
    return wanted if isinstance(wanted, int) else columns.index(wanted)


def _label(template: str, columns: Sequence[str], row: Sequence[str], options: Mapping[str, Any] | None = None) -> str:
    label = re.sub(r"\{([^}]+)\}", lambda match: row[columns.index(match[1])], template)
    return label.partition(options["until"])[0] if options and "until" in options else label


def _drawn(cell: str, wanted: Mapping[str, Any]) -> list[tuple[float, float]]:
    """Return the numbers of a cell to draw, with their half-ranges; none for an empty cell."""
    found = numbers(cell)
    take = wanted.get("take", 0)
    if not cell:
        return []
    if not found or not all(map(math.isfinite, found)):
        raise ValueError(f"the cell {cell!r} has no number to draw; leave its row out.")
    if take == "all":
        return [(value, 0.0) for value in found]
    spread = wanted.get("spread")
    return [(found[take], found[spread] if isinstance(spread, int) and len(found) > spread else 0.0)]
