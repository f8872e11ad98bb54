"""What all figures share: drawn without a display or global pyplot state, and written atomically."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from torchrl_gn.atomic import atomic_path
from torchrl_gn.evaluation import palette

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def new_figure(size: tuple[float, float]) -> Figure:
    """Empty figure of a size in inches.

    Raises:
        ImportError: if matplotlib is not installed.
    """
    # Here, not at the top: training imports this package and needs no matplotlib.
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ImportError('Figures need matplotlib: pip install "torchrl_gn[figures]".') from None

    return Figure(figsize=size, layout="constrained", facecolor="white")


def clean(axes: Axes) -> None:
    """Quiet grid and frame."""
    axes.grid(color=palette.GRID, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=8, color=palette.MUTED)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(palette.MUTED)


def save(figure: Figure, path: str | os.PathLike) -> Path:
    """Write a figure, atomically; its path."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=150)
    return Path(path)
