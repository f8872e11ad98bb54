"""Colours and axes of figures and videos, without a display or global pyplot state."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_gn.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TRUTH = "#3b6ea5"
PREDICTION = "#e0752d"
AXES = ("#c23b4b", "#2e8b57", "#3b6ea5", "#8a5fbf")  # x, y, z and one more for quaternions
SERIES = (TRUTH, PREDICTION, "#c23b4b", "#2e8b57", "#8a5fbf", "#b0892a", "#3fa3a3")  # lines or bars side by side
INK = "#2b2f36"
MUTED = "#8b929c"
GRID = "#dfe3e8"
PAPER = "#fbfbfc"
RGB = tuple[int, int, int]


def blend(color: RGB, other: RGB, part: float) -> RGB:
    """Blend two colours, with a share ``part`` of ``other``."""
    red, green, blue = (round((1 - part) * x + part * y) for x, y in zip(color, other, strict=True))
    return red, green, blue


def new_figure(size: tuple[float, float]) -> Figure:
    """Create an empty figure of ``size`` inches; ImportError if matplotlib is not installed."""
    # Import it here: training imports this package and needs no matplotlib.
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ImportError('Figures need matplotlib: pip install "torchrl_gn[figures]".') from None

    return Figure(figsize=size, layout="constrained", facecolor="white")


def series_color(number: int) -> str:
    """Return the colour of a line or bar; colours repeat after the last of ``SERIES``."""
    return SERIES[number % len(SERIES)]


def clean(axes: Axes) -> None:
    """Style axes with a light grid and frame."""
    axes.grid(color=GRID, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=8, color=MUTED)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(MUTED)


def legend_below(axes: Axes, columns: int) -> None:
    """Put the legend of the axes' lines or bars below the whole figure."""
    options: dict[str, Any] = {"loc": "outside lower center", "ncols": columns, "fontsize": 8, "frameon": False}
    axes.figure.legend(*axes.get_legend_handles_labels(), **options)


def save(figure: Figure, path: str | os.PathLike) -> Path:
    """Write a figure atomically and return its path."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=150)
    return Path(path)
