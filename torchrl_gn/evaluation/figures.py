"""Figures of predictions, training and errors, drawn without a display or global pyplot state."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from torchrl_gn.atomic import atomic_path
from torchrl_gn.evaluation import palette
from torchrl_gn.evaluation.error_table import ErrorTable
from torchrl_gn.modules.state_layout import BODY_STATE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from torchrl_gn.scenes import Scene

_PANELS = (
    ("position", "position [m]", "xyz"),
    ("orientation", "orientation quaternion", "wxyz"),
    ("linear_velocity", "linear velocity [m/s]", "xyz"),
    ("angular_velocity", "angular velocity [rad/s]", "xyz"),
)


def plot_body_trajectory(
    truth: Tensor,
    prediction: Tensor,
    scene: Scene,
    path: str | os.PathLike,
    *,
    node: int | str | None = None,
) -> Path:
    """Predicted against true state of one body (paper, figure "Evaluation rollout in a Swimmer6").

    Four panels: position, quaternion, linear and angular velocity. Quaternion signs
    are chosen so that the true one runs without jumps and the predicted one follows it.

    Args:
        truth: ``[T + 1, N, 13]`` true states.
        prediction: ``[T + 1, N, 13]`` predicted states; values that are not finite leave gaps.
        scene: whose states they are.
        path: file to write; its suffix (``.png``, ``.pdf``, ``.svg``) is the format.
        node: index or name of the body; default the middle moving one (link 3 of Swimmer6, as in the paper).

    Returns:
        The written path.

    Raises:
        ValueError: if the shapes differ or do not fit the scene, or it has no such node.
    """
    expected = (scene.num_nodes, BODY_STATE.size)
    if truth.ndim != 3 or truth.shape != prediction.shape or truth.shape[1:] != expected:
        raise ValueError(
            f"Truth and prediction of scene {scene.name!r} must both be [T + 1, {scene.num_nodes}, 13],"
            f" got {list(truth.shape)} and {list(prediction.shape)}."
        )
    index = _node_index(scene, node)
    true, predicted = (states[:, index].detach().double().cpu().numpy() for states in (truth, prediction))
    where = BODY_STATE.slices["orientation"]
    true, predicted = _align_signs(true.copy(), predicted.copy(), where)
    time = np.arange(len(true)) * scene.timestep

    figure = _figure((9.0, 5.6))
    for axes, (name, label, channels) in zip(figure.subplots(2, 2, sharex=True).flat, _PANELS, strict=True):
        values = BODY_STATE.slices[name]
        for channel, letter in enumerate(channels):
            # The scalar part takes the fourth colour, so that x, y and z keep theirs.
            color = palette.AXES["xyzw".index(letter)]
            axes.plot(time, true[:, values][:, channel], color=color, linewidth=3.2, alpha=0.35)
            axes.plot(time, predicted[:, values][:, channel], color=color, linewidth=1.2, linestyle=(0, (4, 1.5)))
            axes.plot([], [], color=color, label=letter)
        _widen(axes, np.concatenate((true[:, values], predicted[:, values])))
        axes.set_title(label, loc="left", fontsize=10, color=palette.INK)
        axes.legend(ncols=len(channels), fontsize=8, frameon=False, loc="lower right", bbox_to_anchor=(1.01, 0.98))
        axes.margins(x=0.01)
        _clean(axes)
    for axes in figure.axes[2:]:
        axes.set_xlabel("time [s]", fontsize=9)
    figure.suptitle(f"{scene.name}, {scene.node_names[index]}: truth (wide, pale) and prediction (dashed)", fontsize=11)
    return _save(figure, path)


def plot_loglog(
    panels: Mapping[str, Mapping[str, tuple[Sequence[float], Sequence[float]]]],
    path: str | os.PathLike,
    *,
    ylabel: str,
) -> Path:
    """Lines on logarithmic axes, one panel beside the other.

    Args:
        panels: ``(x, y)`` by label, by the name of the panel's horizontal axis.
        path: file to write; its suffix is the format.
        ylabel: name of the vertical axis.

    Returns:
        The written path.
    """
    figure = _figure((4.2 * len(panels) + 0.6, 3.8))
    colors = (palette.TRUTH, palette.PREDICTION, *palette.AXES)
    for axes, (xlabel, lines) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
        for number, (label, (x, y)) in enumerate(lines.items()):
            axes.loglog(x, y, color=colors[number % len(colors)], label=label, linewidth=1.6, marker="o", markersize=4)
        axes.set_xlabel(xlabel)
        axes.set_ylabel(ylabel)
        axes.grid(alpha=0.25, which="both")
        axes.legend(frameon=False)
    return _save(figure, path)


def plot_training_curve(
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    path: str | os.PathLike,
    *,
    ylabel: str = "relative squared error",
) -> Path:
    """Losses or validation errors over training time, on a logarithmic scale.

    Args:
        curves: ``(seconds, values)`` by label; values that are not positive and finite are skipped.
        path: file to write; its suffix is the format.
        ylabel: name of the vertical axis.

    Returns:
        The written path.

    Raises:
        ValueError: if a curve has not as many values as times, or nothing can be drawn.
    """
    kept: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for label, (seconds, values) in curves.items():
        if len(seconds) != len(values):
            raise ValueError(f"Curve {label!r} has {len(seconds)} times and {len(values)} values.")
        x, y = np.asarray(seconds, float), np.asarray(values, float)
        good = np.isfinite(x) & np.isfinite(y) & (y > 0)
        if good.any():
            kept[label] = x[good], y[good]
    if not kept:
        raise ValueError(f"No curve of {list(curves)} has a value above zero to draw.")
    longest = max(x.max() for x, _ in kept.values())
    unit, scale = ("h", 3600) if longest > 3 * 3600 else ("min", 60) if longest > 180 else ("s", 1)

    figure = _figure((7.0, 4.2))
    axes = figure.subplots()
    colors = (palette.TRUTH, palette.PREDICTION, *palette.AXES)
    for number, (label, (x, y)) in enumerate(kept.items()):
        marker = "o" if len(x) <= 60 else None
        axes.plot(
            x / scale,
            y,
            color=colors[number % len(colors)],
            label=label,
            linewidth=1.6,
            marker=marker,
            markersize=3,
        )
    axes.set_yscale("log")
    axes.set_xlabel(f"training time [{unit}]")
    axes.set_ylabel(ylabel)
    axes.legend(frameon=False, fontsize=9)
    _clean(axes)
    return _save(figure, path)


def plot_errors(
    tables: Mapping[str, ErrorTable],
    path: str | os.PathLike,
    *,
    errors: Sequence[str] | None = None,
) -> Path:
    """Bars of errors relative to the constant prediction (paper, figure "One-step and rollout errors").

    One panel an error, one bar a model or system, small marks for its components,
    a dashed line for the constant prediction. A diverged error reaches the top and says so.

    Args:
        tables: by label, for example the system's name.
        path: file to write; its suffix is the format.
        errors: names of the errors to show; default all of the first table.

    Returns:
        The written path.

    Raises:
        ValueError: if there is no table, or a table lacks a named error.
    """
    if not tables:
        raise ValueError("plot_errors needs at least one table.")
    names = list(errors or next(iter(tables.values())).errors)
    for label, table in tables.items():
        missing = [name for name in names if name not in table.errors]
        if missing:
            raise ValueError(f"Table {label!r} lacks the errors {missing}; it has {list(table.errors)}.")
    figure = _figure((max(6.0, 1.5 + len(names) * (1.2 + 0.75 * len(tables))), 4.2))
    panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    shown = [t[name] for t in tables.values() for name in names]
    finite = [v for e in shown for v in (e.total, *e.components.values()) if math.isfinite(v) and v > 0] + [1.0]
    bottom, top = 10.0 ** math.floor(math.log10(0.8 * min(finite))), 3 * max(finite)
    markers = dict(zip(BODY_STATE.names, "osD^", strict=True))
    for axes, name in zip(panels, names, strict=True):
        for place, table in enumerate(tables.values()):
            error = table[name]
            diverged = not math.isfinite(error.total)
            color = palette.MUTED if diverged else palette.TRUTH
            axes.bar(place, top if diverged else max(error.total, bottom), width=0.62, color=color, alpha=0.85)
            if diverged:
                axes.text(
                    place,
                    math.sqrt(bottom * top),
                    "diverged",
                    rotation=90,
                    ha="center",
                    va="center",
                    color="w",
                )
            for component, value in error.components.items():
                if bottom < value < top:
                    marker = markers.get(component, ".")
                    axes.plot(place, value, marker, color=palette.INK, markersize=4, markerfacecolor="w")
        axes.axhline(1.0, color=palette.INK, linestyle="--", linewidth=1)
        axes.set_xticks(range(len(tables)), tables.keys(), rotation=30 if len(tables) > 3 else 0, fontsize=9)
        axes.set_xlim(-0.6, len(tables) - 0.4)
        axes.set_title(name.replace("_error", "").replace("_", " "), fontsize=10)
        axes.set_yscale("log")
        axes.set_ylim(bottom, top)
        _clean(axes)
    panels[0].set_ylabel("squared error / constant prediction's")
    for component, marker in markers.items():
        panels[-1].plot([], [], marker, color=palette.INK, markerfacecolor="w", label=component.replace("_", " "))
    panels[-1].plot([], [], "--", color=palette.INK, label="constant prediction")
    figure.legend(
        *panels[-1].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=5,
        fontsize=8,
        frameon=False,
    )
    return _save(figure, path)


def plot_bars(
    panels: Mapping[str, Mapping[str, Mapping[str, tuple[float, float]]]],
    path: str | os.PathLike,
    *,
    ylabel: str = "squared error / constant prediction's",
) -> Path:
    """Groups of bars on a logarithmic axis (paper, figure "One-step and rollout errors for different models").

    One panel below the other, in each a group for every system, in each group a bar for every model, with a
    dashed line at 1, the constant prediction. What is not finite reaches the top, hatched.

    Args:
        panels: ``(height, half-range)`` by system, by model, by the panel's title; a system that a model lacks
            leaves a gap.
        path: file to write; its suffix is the format.
        ylabel: name of the vertical axis.

    Returns:
        The written path.

    Raises:
        ValueError: if there is nothing to draw.
    """
    models = list(dict.fromkeys(model for panel in panels.values() for model in panel))
    groups = list(dict.fromkeys(group for panel in panels.values() for bars in panel.values() for group in bars))
    heights = [height for panel in panels.values() for bars in panel.values() for height, _ in bars.values()]
    if not heights:
        raise ValueError("plot_bars needs at least one bar.")
    finite = [height for height in heights if math.isfinite(height) and height > 0] + [1.0]
    bottom, top = 10.0 ** math.floor(math.log10(0.8 * min(finite))), 3 * max(finite)
    figure = _figure((max(6.0, 1.6 + 0.22 * len(groups) * (len(models) + 1)), 3.4 * len(panels) + 0.3 * len(models)))
    colors = (palette.TRUTH, palette.PREDICTION, *palette.AXES)
    width = 0.84 / len(models)
    for axes, (title, panel) in zip(figure.subplots(len(panels), 1, squeeze=False)[:, 0], panels.items(), strict=True):
        for number, model in enumerate(models):
            # Colours repeat after a while, then lighter.
            look = {"color": colors[number % len(colors)], "alpha": 0.9 if number < len(colors) else 0.45}
            axes.bar(0, 0, label=model, **look)
            for group, (height, spread) in panel.get(model, {}).items():
                place = groups.index(group) + (number - (len(models) - 1) / 2) * width
                known = math.isfinite(height)
                axes.bar(place, max(height, bottom) if known else top, width, hatch=None if known else "//", **look)
                if known and spread > 0:
                    axes.errorbar(place, height, min(spread, 0.999 * height), color=palette.INK, linewidth=1)
        axes.axhline(1.0, color=palette.INK, linestyle="--", linewidth=1)
        axes.set_xticks(range(len(groups)), groups, rotation=30 if len(groups) > 6 else 0, fontsize=9)
        axes.set_xlim(-0.6, len(groups) - 0.4)
        axes.set_yscale("log")
        axes.set_ylim(bottom, top)
        axes.set_ylabel(ylabel, fontsize=8)
        axes.set_title(title, fontsize=10)
        _clean(axes)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(4, len(models)), fontsize=8, frameon=False)
    return _save(figure, path)


def _node_index(scene: Scene, node: int | str | None) -> int:
    if node is None:
        moving = np.flatnonzero(scene.predicted)
        if not len(moving):
            raise ValueError(f"Nothing moves in scene {scene.name!r}.")
        return int(moving[(len(moving) - 1) // 2])
    if isinstance(node, str):
        if node not in scene.node_names:
            raise ValueError(f"Scene {scene.name!r} has no node {node!r}, only {list(scene.node_names)}.")
        return scene.node_names.index(node)
    if not 0 <= node < scene.num_nodes:
        raise ValueError(f"Scene {scene.name!r} has nodes 0 to {scene.num_nodes - 1}, not {node}.")
    return node


def _align_signs(true: np.ndarray, predicted: np.ndarray, where: slice) -> tuple[np.ndarray, np.ndarray]:
    q, p = true[:, where], predicted[:, where]
    # The product of all sign changes so far undoes every jump between q and -q.
    jumps = np.where((q[1:] * q[:-1]).sum(-1) < 0, -1.0, 1.0)
    q[1:] *= np.cumprod(jumps)[:, None]
    p *= np.where(np.nan_to_num(p * q).sum(-1) < 0, -1.0, 1.0)[:, None]
    return true, predicted


def _widen(axes: Axes, values: np.ndarray) -> None:
    """Keep a panel in which nothing moves from zooming into rounding errors."""
    finite = values[np.isfinite(values)]
    if finite.size and np.ptp(finite) < 1e-6:
        axes.set_ylim(finite.mean() - 0.1, finite.mean() + 0.1)


def _figure(size: tuple[float, float]) -> Figure:
    # Here, not at the top: training imports this package and need not load matplotlib.
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained", facecolor="white")


def _clean(axes: Axes) -> None:
    axes.grid(color=palette.GRID, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=8, color=palette.MUTED)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(palette.MUTED)


def _save(figure: Figure, path: str | os.PathLike) -> Path:
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=150)
    return Path(path)
