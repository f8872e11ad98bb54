"""Draw the figures of the report, among them learning curves beside peers', one panel for each task."""

from __future__ import annotations

import io
import math
import statistics
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from _report.curves import CurvePanel, Line
from _report.figures import DIGEST, Points, ReportFigure, numbers
from torchrl_gn.atomic import atomic_path
from torchrl_gn.drawing.canvas import GRID, INK, MUTED, TRUTH, clean, new_figure, series_color

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDE = 7.0  # inches: 1,050 pixels, shown at about 700
_QUIET = "#b4bac3"  # bars that are not ours
_TEXT = 8.5
_NAMES: dict[str, Any] = {"fontsize": 9, "color": INK}  # of a figure's axes
_COLORS = 64
_LONG = 10_000  # least number that is written with a comma
# Okabe and Ito's colours without blue, which is ours; and markers, for colour-blind readers and monochrome prints.
_PEERS = (("#d55e00", "o"), ("#009e73", "s"), ("#cc79a7", "^"), ("#e69f00", "D"), ("#56b4e9", "v"), (MUTED, "X"))
_MARKERS = (("o", 6.0), ("s", 5.5), ("^", 6.5), ("D", 5.0), ("v", 6.5))  # of series, and sizes that look alike
_TOP = 1000  # the highest return of the suite's tasks
_TICK = 250
_SHADES = 4  # shades of each colour, for the smooth edges of lines; the lightest is the band's

_Bar = tuple[float, float, float]  # its place, its value, and where its drawing ends


def draw_figure(figure: ReportFigure, file: Path) -> None:
    """Draw a figure into a PNG that keeps its digest."""
    if figure.options["kind"] == "curves":
        _save(_curves_canvas(figure), file, figure.digest, _curves_palette())
        return
    options, panels = figure.options, list(figure.panels.values())
    count, lines = len(panels), options["kind"] == "lines"
    columns = min(3, count)
    tall = (2.1 if count > 1 else 2.6) if lines else max(_height(points, options) for points in panels)
    canvas, places = _grid(count, columns, 0.7, tall + 0.3 * (count > 1), sharey=options.get("share", False))
    for number, (axes, (title, points)) in enumerate(zip(places, figure.panels.items(), strict=True)):
        (_lines if lines else _rows)(axes, points, options)
        if count > 1 and not options.get("log"):
            axes.locator_params(axis="y" if lines else "x", nbins=4)
        axes.set_title(textwrap.fill(title, 28), fontsize=8, loc="left", color=INK)
        if not lines and number % columns and list(points) == list(panels[0]):
            axes.tick_params(axis="y", labelleft=False)  # the first panel of a row names them
    across, up = (options["along"], options["axis"]) if lines else (textwrap.fill(options["axis"], 76), None)
    canvas.supxlabel(across, **_NAMES) if count > 1 else places[0].set_xlabel(across, **_NAMES)
    if up:
        canvas.supylabel(up, **_NAMES) if count > 1 else places[0].set_ylabel(up, **_NAMES)
    _save(canvas, file, figure.digest)


def _grid(count: int, columns: int, margin: float, tall: float, **shared: Any) -> tuple[Figure, list[Axes]]:
    """Return a figure with ``count`` panels, in rows ``tall`` inches high, and ``margin`` inches for their names."""
    rows = -(-count // columns)
    canvas = new_figure((_WIDE, margin + rows * tall))
    places = list(canvas.subplots(rows, columns, squeeze=False, **shared).flat)
    for axes in places[count:]:
        axes.remove()
    return canvas, places[:count]


def _save(canvas: Figure, file: Path, digest: str, palette: Sequence[int] = ()) -> None:
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
                values, spreads = zip(*drawn, strict=True)
                _dots(axes, values, [where] * len(drawn), color, _marker(number), xerr=spreads)
    if log:
        _log_ticks(axes)
    elif max(map(abs, axes.get_xlim())) >= _LONG:
        axes.xaxis.set_major_formatter("{x:,.0f}")
    if bars:
        _name_bars(axes, written, inside="between" in options)
    axes.set_yticks(range(len(points)), list(points))
    axes.set_ylim(len(points) - 0.45, -0.55)
    if len(series) > 1:
        for number, name in enumerate(series):
            shape: dict[str, Any] = {"marker": "s"} if bars else _marker(number)
            axes.plot([], [], linestyle="", color=series_color(number), label=name, **shape)
        style: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (-0.02, 0.99), "ncols": len(series)}
        axes.legend(frameon=False, fontsize=_TEXT, handletextpad=0.2, columnspacing=1.2, **style)
    if "from" in options:
        axes.set_xlim(left=options["from"])
    if "at" in options:
        # Behind bars, with the grid: the line would strike through the numbers in them.
        axes.axvline(options["at"], color=INK, linestyle="--", linewidth=1, zorder=0.9)
    clean(axes)
    axes.tick_params(axis="y", labelsize=_TEXT, length=0)
    if bars:
        axes.grid(visible=False, axis="y")


def _marker(number: int) -> dict[str, Any]:
    """Return the marker of a series, and its size."""
    return dict(zip(("marker", "markersize"), _MARKERS[number % len(_MARKERS)], strict=True))


def _dots(
    axes: Axes, x: Sequence[float], y: Sequence[float], color: str, marker: dict[str, Any], **ranges: Sequence[float]
) -> None:
    """Draw dots, with half-ranges ``xerr`` or ``yerr`` where these are not zero."""
    ranges = {key: spreads for key, spreads in ranges.items() if any(spreads)}
    style: dict[str, Any] = {"linestyle": "", "markeredgecolor": "white", "markeredgewidth": 0.5, **marker}
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
    behind = {"facecolor": "white", "edgecolor": "none", "pad": 0.6}  # over a dashed line
    style |= {"color": "white", "ha": "right"} if inside else {"color": INK, "bbox": behind}
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
            _dots(axes, [x] * len(values), heights, color, _marker(number), yerr=spreads)
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


def _curves_canvas(figure: ReportFigure) -> Figure:
    """Draw learning curves in panels with shared axes, and a legend above them."""
    count, end = len(figure.panels), figure.options["frames"]
    columns = 2 if count in (2, 4) else min(count, 3 if count <= 6 else 4)
    canvas, places = _grid(count, columns, 0.8, {1: 2.6, 2: 2.3, 3: 1.8}.get(columns, 1.45), sharex=True, sharey=True)
    names = list(dict.fromkeys(name for panel in figure.panels.values() for name in panel["peers"]))
    plans = any(panel["planned"] for panel in figure.panels.values())
    for number, (axes, (title, panel)) in enumerate(zip(places, figure.panels.items(), strict=True)):
        _panel(axes, panel, names, plans=plans)
        axes.set_title(title, fontsize=8, loc="left", color=INK)
        axes.tick_params(axis="x", labelbottom=number >= count - columns)  # only the last of a column
    step = end // (2 if columns > 2 else 4)
    places[0].set_xticks(range(0, end + 1, step), [f"{at / 1000:g}" for at in range(0, end + 1, step)])
    places[0].set_yticks(range(0, _TOP + 1, _TICK), [f"{at:,}" for at in range(0, _TOP + 1, _TICK)])
    places[0].set_xlim(0, end)
    places[0].set_ylim(0, 1.02 * _TOP)
    canvas.supxlabel(figure.options["along"], **_NAMES)
    canvas.supylabel(figure.options["axis"], **_NAMES)
    handles = places[0].get_legend_handles_labels()
    options: dict[str, Any] = {"loc": "outside upper center", "ncols": len(handles[0]), "fontsize": 8, "frameon": False}
    canvas.legend(*handles, handlelength=1.8, handletextpad=0.4, columnspacing=1, **options)
    return canvas


def _curves_palette() -> list[int]:
    """Return red, green and blue of all colours in the figure, and of their shades towards white."""
    from matplotlib.colors import to_rgb

    shades = [each / _SHADES for each in range(_SHADES, 0, -1)]
    drawn = [(color, share) for color in (INK, TRUTH, *(color for color, _ in _PEERS)) for share in shades]
    drawn += [("white", 1), (GRID, 1)]
    return [round(255 * (1 - share * (1 - part))) for color, share in drawn for part in to_rgb(color)]


def _panel(axes: Axes, panel: CurvePanel, names: list[str], *, plans: bool) -> None:
    axes.plot(*_across(panel["mean"]), color=TRUTH, linewidth=2.4, zorder=4, label="ours")
    if plans:
        star: dict[str, Any] = {"marker": "*", "markersize": 9, "markeredgecolor": "white", "markeredgewidth": 0.6}
        axes.plot(*_across(panel["planned"]), color=TRUTH, linestyle="", zorder=5, label="ours, planned", **star)
    if len(panel["seeds"]) > 1:
        for line in panel["seeds"]:
            axes.plot(*_across(line), color=TRUTH, linewidth=0.7, zorder=3)
    if panel["band"]:
        frames, low, high = zip(*panel["band"], strict=True)
        axes.fill_between(frames, low, high, color=TRUTH, alpha=1 / _SHADES, linewidth=0, zorder=2)
    for number, name in enumerate(names):
        color, marker = _PEERS[number % len(_PEERS)]
        style: dict[str, Any] = {"color": color, "marker": marker, "markersize": 3.2, "linewidth": 1, "label": name}
        axes.plot(*_across(panel["peers"].get(name, [])), zorder=2.5, **style)
    clean(axes)


def _across(line: Line) -> tuple[list[float], list[float]]:
    """Return frames and returns of a line."""
    return [at for at, _ in line], [value for _, value in line]
