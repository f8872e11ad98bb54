"""Draw learning curves beside peers', one panel for each task."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from _common.report_curves import CurvePanel, Line
from _common.report_figures import ReportFigure
from torchrl_gn.drawing.canvas import GRID, INK, MUTED, TRUTH, clean, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours without blue, which is ours; and markers, for colour-blind readers and monochrome prints.
_PEERS = (("#d55e00", "o"), ("#009e73", "s"), ("#cc79a7", "^"), ("#e69f00", "D"), ("#56b4e9", "v"), (MUTED, "X"))
_TOP = 1000  # the highest return of the suite's tasks
_TICK = 250
_SHADES = 4  # shades of each colour, for the smooth edges of lines; the lightest is the band's


def curves_canvas(figure: ReportFigure, width: float) -> Figure:
    """Draw panels with shared axes in a figure ``width`` inches wide, and a legend above them."""
    count, end = len(figure.panels), figure.options["frames"]
    columns = 2 if count in (2, 4) else min(count, 3 if count <= 6 else 4)
    rows = -(-count // columns)
    tall = {1: 2.6, 2: 2.3, 3: 1.8}.get(columns, 1.45)
    canvas = new_figure((width, 0.8 + rows * tall))
    places = list(canvas.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).flat)
    names = list(dict.fromkeys(name for panel in figure.panels.values() for name in panel["peers"]))
    for number, (axes, (title, panel)) in enumerate(zip(places, figure.panels.items(), strict=False)):
        _panel(axes, panel, names)
        axes.set_title(title, fontsize=8, loc="left", color=INK)
        axes.tick_params(axis="x", labelbottom=number >= count - columns)  # only the last of a column
    for axes in places[count:]:
        axes.remove()
    step = end // (2 if columns > 2 else 4)
    places[0].set_xticks(range(0, end + 1, step), [f"{at / 1000:g}" for at in range(0, end + 1, step)])
    places[0].set_yticks(range(0, _TOP + 1, _TICK), [f"{at:,}" for at in range(0, _TOP + 1, _TICK)])
    places[0].set_xlim(0, end)
    places[0].set_ylim(0, 1.02 * _TOP)
    style: dict[str, Any] = {"fontsize": 9, "color": INK}
    canvas.supxlabel(figure.options["along"], **style)
    canvas.supylabel(figure.options["axis"], **style)
    handles = places[0].get_legend_handles_labels()
    options: dict[str, Any] = {"loc": "outside upper center", "ncols": len(names) + 1, "fontsize": 8, "frameon": False}
    canvas.legend(*handles, handlelength=1.8, handletextpad=0.4, columnspacing=1, **options)
    return canvas


def curves_palette() -> list[int]:
    """Return red, green and blue of all colours in the figure, and of their shades towards white."""
    from matplotlib.colors import to_rgb

    shades = [each / _SHADES for each in range(_SHADES, 0, -1)]
    drawn = [(color, share) for color in (INK, TRUTH, *(color for color, _ in _PEERS)) for share in shades]
    drawn += [("white", 1), (GRID, 1)]
    return [round(255 * (1 - share * (1 - part))) for color, share in drawn for part in to_rgb(color)]


def _panel(axes: Axes, panel: CurvePanel, names: list[str]) -> None:
    axes.plot(*_across(panel["mean"]), color=TRUTH, linewidth=2.4, zorder=4, label="ours")
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
