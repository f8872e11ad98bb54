"""Draw the figures of the report."""

from __future__ import annotations

import io
import math
import statistics
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from _common.report_curve_drawing import curves_canvas, curves_palette
from _common.report_figures import DIGEST, Points, ReportFigure, numbers
from torchrl_gn.atomic import atomic_path
from torchrl_gn.drawing.canvas import INK, MUTED, TRUTH, clean, new_figure, series_color

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDE = 7.0  # inches: 1,050 pixels, shown at about 700
_QUIET = "#b4bac3"  # bars that are not ours
_TEXT = 8.5
_COLORS = 64

_Bar = tuple[float, float, float]  # its place, its value, and where its drawing ends


def draw_figure(figure: ReportFigure, file: Path) -> Path:
    """Draw a figure into a PNG that keeps its digest, and return the file."""
    if figure.options["kind"] == "curves":
        return _save(curves_canvas(figure, _WIDE), file, figure.digest, curves_palette())
    options, panels = figure.options, list(figure.panels.values())
    count, lines = len(panels), options["kind"] == "lines"
    columns = min(3, count)
    rows = -(-count // columns)
    tall = 2.1 if lines else max(_height(points, options) for points in panels)
    canvas = new_figure((_WIDE, 3.3 if lines and count == 1 else 0.7 + rows * (tall + 0.3 * (count > 1))))
    places = list(canvas.subplots(rows, columns, squeeze=False, sharey=options.get("share", False)).flat)
    for number, (axes, (title, points)) in enumerate(zip(places, figure.panels.items(), strict=False)):
        (_lines if lines else _rows)(axes, points, options)
        if count > 1 and not options.get("log"):
            axes.locator_params(axis="y" if lines else "x", nbins=4)
        axes.set_title(textwrap.fill(title, 28), fontsize=8, loc="left", color=INK)
        if not lines and number % columns and list(points) == list(panels[0]):
            axes.tick_params(axis="y", labelleft=False)  # the first panel of a row names them
    for axes in places[count:]:
        axes.remove()
    across, up = (options["along"], options["axis"]) if lines else (textwrap.fill(options["axis"], 76), None)
    style: dict[str, Any] = {"fontsize": 9, "color": INK}
    canvas.supxlabel(across, **style) if count > 1 else places[0].set_xlabel(across, **style)
    if up:
        canvas.supylabel(up, **style) if count > 1 else places[0].set_ylabel(up, **style)
    return _save(canvas, file, figure.digest)


def _save(canvas: Figure, file: Path, digest: str, palette: Sequence[int] = ()) -> Path:
    """Write a PNG with its digest, reduced to few colours (a third of the size) or to those of ``palette``."""
    from PIL import Image, PngImagePlugin  # matplotlib needs it, so it is there

    canvas.savefig(drawn := io.BytesIO(), dpi=150)
    texts = PngImagePlugin.PngInfo()
    texts.add_text(DIGEST, digest)
    image = Image.open(drawn).convert("RGB")
    if palette:
        colors = Image.new("P", (1, 1))
        colors.putpalette(palette)
        few = image.quantize(palette=colors, dither=Image.Dither.NONE)
    else:
        few = image.quantize(_COLORS, Image.Quantize.MAXCOVERAGE)
    with atomic_path(file) as temporary:
        few.save(temporary, optimize=True, pnginfo=texts)
    return file


def _height(points: Points, options: Mapping[str, Any]) -> float:
    """Return the height in inches of a panel of rows."""
    series = len(_series(points))
    each = 0.17 if options["kind"] == "bars" else 0.1
    return 0.35 + len(points) * max(0.26, each * series) + (0.25 if series > 1 else 0)


def _series(points: Points) -> list[str]:
    return list(dict.fromkeys(name for row in points.values() for name in row))


def _rows(axes: Axes, points: Points, options: Mapping[str, Any]) -> None:
    """Draw rows of dots or bars; a bar is the mean of its row's dots."""
    series, bars, log = _series(points), options["kind"] == "bars", options.get("log", False)
    width = 0.78 / len(series) if bars else min(0.2, 0.64 / len(series))
    written: list[_Bar] = []
    for place, (label, row) in enumerate(points.items()):
        for number, name in enumerate(series):
            drawn = [(value, spread) for value, spread in row.get(name, ()) if value > 0 or not log]
            where = place + (number - (len(series) - 1) / 2) * width
            quiet = label not in options.get("ours", points)
            color = series_color(number) if len(series) > 1 else (_QUIET if bars else MUTED) if quiet else TRUTH
            if drawn and bars:
                written.append(_bar(axes, where, width, drawn, color))
            elif drawn:
                _dots(
                    axes, [value for value, _ in drawn], [where] * len(drawn), color, xerr=[each for _, each in drawn]
                )
    if log:
        _log_ticks(axes)
    if bars:
        _name_bars(axes, written, inside="between" in options)
    axes.set_yticks(range(len(points)), list(points))
    axes.set_ylim(len(points) - 0.45, -0.55)
    if len(series) > 1:
        for number, name in enumerate(series):
            axes.plot([], [], "s" if bars else "o", color=series_color(number), label=name)
        style: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (-0.02, 0.99), "ncols": len(series)}
        axes.legend(frameon=False, fontsize=_TEXT, handletextpad=0.2, columnspacing=1.2, **style)
    if "from" in options:
        axes.set_xlim(left=options["from"])
    if "at" in options:
        axes.axvline(options["at"], color=INK, linestyle="--", linewidth=1, zorder=1.5)
    clean(axes)
    axes.tick_params(axis="y", labelsize=_TEXT, length=0)
    if bars:
        axes.grid(visible=False, axis="y")


def _dots(axes: Axes, x: Sequence[float], y: Sequence[float], color: str, **ranges: Sequence[float]) -> None:
    """Draw dots, with half-ranges ``xerr`` or ``yerr`` where these are not zero."""
    ranges = {key: spreads for key, spreads in ranges.items() if any(spreads)}
    style: dict[str, Any] = {"fmt": "o", "markersize": 6, "markeredgecolor": "white", "markeredgewidth": 0.5}
    axes.errorbar(x, y, color=color, elinewidth=1, capsize=2, **ranges, **style)


def _log_ticks(axes: Axes) -> None:
    """Make the horizontal axis logarithmic, without overlapping labels if it is short."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    low, high = axes.get_xlim()
    if high < 60 * low:
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _bar(axes: Axes, place: float, width: float, drawn: Sequence[tuple[float, float]], color: str) -> _Bar:
    values = [value for value, _ in drawn]
    mean, spread = statistics.fmean(values), drawn[0][1] if len(drawn) == 1 else 0.0
    axes.barh(place, mean, height=0.9 * width, color=color)
    if len(values) > 1:
        axes.plot(values, [place] * len(values), "o", color=INK, markersize=3)
    elif spread:
        axes.errorbar(mean, place, xerr=spread, color=INK, elinewidth=1, capsize=2)
    return place, mean, max(0.0, mean + spread, *values)


def _name_bars(axes: Axes, bars: Sequence[_Bar], inside: bool) -> None:
    """Write each bar's value after its end, or ``inside`` it, all with the same number of digits."""
    digits = max(len(f"{value:.3g}".partition(".")[2]) if abs(value) < 100 else 0 for _, value, _ in bars)
    style: dict[str, Any] = {"va": "center", "fontsize": 8, "textcoords": "offset points"}
    style |= {"color": "white", "ha": "right"} if inside else {"color": INK}
    for place, value, end in bars:
        axes.annotate(f"{value:,.{digits}f}", (end, place), (-4 if inside else 4, 0), **style)
    axes.margins(x=0.1)


def _lines(axes: Axes, points: Points, options: Mapping[str, Any]) -> None:
    """Draw lines through the medians of their dots, and name them at their ends."""
    places = {label: numbers(label)[0] for label in points}
    ends: list[tuple[float, str, str]] = []
    series = _series(points)
    for number, name in enumerate(series):
        color = series_color(number)
        drawn = [(places[label], row[name]) for label, row in points.items() if row.get(name)]
        middles = [statistics.median(value for value, _ in values) for _, values in drawn]
        axes.plot([x for x, _ in drawn], middles, color=color, linewidth=1.8)
        for x, values in drawn:
            heights, spreads = zip(*values, strict=True)
            _dots(axes, [x] * len(values), heights, color, yerr=spreads)
        ends.append((middles[-1], name, color))
    if options.get("log"):
        axes.set_yscale("log")
        axes.set_xscale("log")
    _name_places(axes, sorted(set(places.values())))
    if "from" in options:
        axes.set_ylim(bottom=options["from"])
    if len(series) > 1:
        _name_ends(axes, max(places.values()), ends)
    if "at" in options:
        axes.axhline(options["at"], color=INK, linestyle="--", linewidth=1)
    clean(axes)


def _name_places(axes: Axes, places: Sequence[float]) -> None:
    """Set ticks at all places, and label them from the last backwards where labels do not overlap."""
    grid = axes.get_subplotspec()
    room = 0.016 * (grid.get_gridspec().ncols if grid else 1)  # a character's share of the panel's width
    to_fraction = axes.transData + axes.transAxes.inverted()
    names, before = [], math.inf
    for place in reversed(places):
        at, name = float(to_fraction.transform((place, axes.get_ylim()[1]))[0]), f"{place:,.0f}"
        shown = before - at >= room * len(name)
        names.append(name if shown else "")
        before = at if shown else before
    axes.set_xticks(places, names[::-1])
    axes.set_xticks([], minor=True)


def _name_ends(axes: Axes, last: float, ends: Sequence[tuple[float, str, str]]) -> None:
    """Write names beside the ends of lines, moved apart where they would overlap."""
    to_fraction = axes.transData + axes.transAxes.inverted()
    heights = [(float(to_fraction.transform((last, value))[1]), name, color) for value, name, color in ends]
    before = -1.0
    for height, name, color in sorted(heights):
        before = max(height, before + 0.075)
        style: dict[str, Any] = {"va": "center", "fontsize": _TEXT, "color": color, "annotation_clip": False}
        place = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points"}
        axes.annotate(name, (last, before), (8, 0), **place, **style)
