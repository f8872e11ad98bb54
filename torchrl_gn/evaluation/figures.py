"""Figures of errors, training and run time. Each function writes one file, whose suffix sets the format."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from torch import Tensor

from torchrl_gn.drawing.canvas import INK, MUTED, SERIES, TRUTH, clean, legend_below, new_figure, save, series_color
from torchrl_gn.evaluation.error_table import ErrorTable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDEST = 12.0  # maximum width of panels side by side, inches
_CURVES = (6.4, 3.8)  # size of a figure of curves, inches


def plot_loglog(
    panels: Mapping[str, Mapping[str, tuple[Sequence[float], Sequence[float]]]], path: str | os.PathLike, *, ylabel: str
) -> Path:
    """Plot lines on logarithmic axes, in panels side by side.

    ``panels[xlabel][label]`` is a line ``(x, y)``; ``xlabel`` names the panel's horizontal axis.
    """
    figure = new_figure((4.2 * len(panels) + 0.6, 3.8))
    for axes, (xlabel, lines) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
        for number, (label, (x, y)) in enumerate(lines.items()):
            axes.loglog(x, y, color=series_color(number), label=label, linewidth=1.6, marker="o", markersize=4)
        counts = sorted({value for x, _ in lines.values() for value in x})
        if all(float(value).is_integer() for value in counts) and len(counts) < 10:
            axes.set_xticks(counts, [f"{value:,.0f}" for value in counts])  # the default labels may overlap
            axes.set_xticks([], minor=True)
        axes.set(xlabel=xlabel, ylabel=ylabel)
        axes.grid(alpha=0.25, which="both")
        axes.legend(frameon=False)
    return save(figure, path)


def plot_rewards(
    rewards: Mapping[str, Tensor], path: str | os.PathLike, *, timestep: float, ylabel: str = "reward"
) -> Path:
    """Plot rewards of planners or policies over time: the mean of the episodes, in a pale band from worst to best.

    Args:
        rewards: rewards ``[B, T]`` of each planner or policy, by label; NaN after the end of an episode.
        path: file of the figure.
        timestep: control step in seconds.
        ylabel: label of the vertical axis.
    """
    axes = new_figure(_CURVES).subplots()
    for number, (label, values) in enumerate(rewards.items()):
        values = values.detach().double().cpu().numpy()
        time = timestep * np.arange(1, values.shape[1] + 1)
        running = np.isfinite(values).any(0)  # steps that some episode reaches
        values = values[:, running]
        band = np.nanmin(values, 0), np.nanmean(values, 0), np.nanmax(values, 0)
        _band(axes, time[running], *band, series_color(number), label)
    return _finish(axes, "time [s]", ylabel, path)


def plot_planning_curves(
    curves: Mapping[str, tuple[Sequence[float], Sequence[float], Sequence[float]]], path: str | os.PathLike
) -> Path:
    """Plot rewards over planning time, on a logarithmic axis, with error bars.

    Args:
        curves: by label, three sequences ``[N]``: milliseconds of planning per control step, mean rewards, and
            half-lengths of their error bars.
        path: file of the figure.
    """
    axes = new_figure(_CURVES).subplots()
    style = {"linewidth": 1.6, "marker": "o", "markersize": 4, "elinewidth": 0.8, "capsize": 2}
    for number, (label, (times, rewards, deviations)) in enumerate(curves.items()):
        axes.errorbar(times, rewards, yerr=deviations, color=series_color(number), label=label, **style)
    axes.set_xscale("log")
    return _finish(axes, "planning a control step [ms]", "mean reward of a step", path)


def plot_learning_curves(
    curves: Mapping[str, tuple[Sequence[float], Sequence[Sequence[float]]]], path: str | os.PathLike
) -> Path:
    """Plot returns over environment steps: median of the seeds, band of their quartiles (paper, "Learning curves").

    Args:
        curves: by label, environment steps ``[T]`` and the returns ``[S, T]`` of ``S`` seeds.
        path: file of the figure.

    Raises:
        ValueError: if a seed has another number of returns than of steps.
    """
    axes = new_figure(_CURVES).subplots()
    for number, (label, (frames, returns)) in enumerate(curves.items()):
        if set(lengths := [len(curve) for curve in returns]) - {len(frames)}:
            raise ValueError(f"Every seed of {label!r} must have {len(frames)} returns, got {lengths}.")
        low, median, high = np.quantile(np.asarray(returns, float), (0.25, 0.5, 0.75), axis=0)
        _band(axes, frames, low, median, high, series_color(number), label)
    return _finish(axes, "environment steps", "return of an episode", path)


def plot_training_curve(
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    path: str | os.PathLike,
    *,
    ylabel: str = "relative squared error",
) -> Path:
    """Plot losses or validation errors over training time, on a logarithmic scale.

    Args:
        curves: by label, seconds and values. Values that are not positive and finite are skipped.
        path: file of the figure.
        ylabel: label of the vertical axis.
    """
    finite_curves: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for label, (seconds, values) in curves.items():
        if len(seconds) != len(values):
            raise ValueError(f"Curve {label!r} has {len(seconds)} times and {len(values)} values.")
        x, y = np.asarray(seconds, float), np.asarray(values, float)
        good = np.isfinite(x) & np.isfinite(y) & (y > 0)
        if good.any():
            finite_curves[label] = x[good], y[good]
    if not finite_curves:
        raise ValueError(f"No curve of {list(curves)} has a value above zero to draw.")
    longest = max(x.max() for x, _ in finite_curves.values())
    unit, scale = ("h", 3600) if longest > 3 * 3600 else ("min", 60) if longest > 180 else ("s", 1)
    axes = new_figure((7.0, 4.2)).subplots()
    for number, (label, (x, y)) in enumerate(finite_curves.items()):
        look = {"color": series_color(number), "marker": "o" if len(x) <= 60 else None}
        axes.plot(x / scale, y, label=label, linewidth=1.6, markersize=3, **look)
    axes.set_yscale("log")
    return _finish(axes, f"training time [{unit}]", ylabel, path)


def plot_errors(
    tables: Mapping[str, ErrorTable], path: str | os.PathLike, *, errors: Sequence[str] | None = None
) -> Path:
    """Plot bars of errors relative to the persistence baseline (paper, figure "One-step and rollout errors").

    There is one panel per error and one bar per table, with small marks for its components. The bar of a diverged error
    reaches the top.

    Args:
        tables: error tables by label, for example by the system's name.
        errors: names of the errors to show. Default: all of the first table.
    """
    if not tables:
        raise ValueError("plot_errors needs at least one table.")
    names = list(errors or next(iter(tables.values())).errors)
    for label, table in tables.items():
        if missing := [name for name in names if name not in table.errors]:
            raise ValueError(f"Table {label!r} lacks the errors {missing}; it has {list(table.errors)}.")
    figure = new_figure((max(6.0, 1.5 + len(names) * (1.2 + 0.75 * len(tables))), 4.2))
    panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    table_errors = [t[name] for t in tables.values() for name in names]
    bottom, top = _log_range(v for e in table_errors for v in (e.total, *e.components.values()))
    components = dict.fromkeys(component for error in table_errors for component in error.components)
    markers = dict(zip(components, itertools.cycle("osD^v<>"), strict=False))
    for axes, name in zip(panels, names, strict=True):
        for x, table in enumerate(tables.values()):
            error = table[name]
            height, color = (max(error.total, bottom), TRUTH) if math.isfinite(error.total) else (top, MUTED)
            axes.bar(x, height, width=0.62, color=color, alpha=0.85)
            if not math.isfinite(error.total):
                axes.text(x, (bottom * top) ** 0.5, "diverged", rotation=90, ha="center", va="center", color="w")
            for component, value in error.components.items():
                if bottom < value < top:
                    axes.plot(x, value, markers[component], color=INK, markersize=4, markerfacecolor="w")
        _frame_bars(axes, name.replace("_error", "").replace("_", " "), tables, (bottom, top), horizontal=3)
    panels[0].set_ylabel("squared error / persistence baseline's")
    for component, marker in markers.items():
        panels[-1].plot([], [], marker, color=INK, markerfacecolor="w", label=component.replace("_", " "))
    panels[-1].plot([], [], "--", color=INK, label="persistence baseline")
    legend_below(panels[-1], 5)
    return save(figure, path)


def plot_bars(
    panels: Mapping[str, Mapping[str, Mapping[str, tuple[float, float]]]],
    path: str | os.PathLike,
    *,
    ylabel: str = "squared error / persistence baseline's",
) -> Path:
    """Plot groups of bars on a logarithmic axis (paper, figure "One-step and rollout errors for different models").

    ``panels[title][model][system]`` is ``(height, half-range)``; a missing system leaves a gap. The dashed line is the
    persistence baseline. Bars of non-finite height reach the top, hatched.
    """
    models = list(dict.fromkeys(model for panel in panels.values() for model in panel))
    groups = list(dict.fromkeys(group for panel in panels.values() for bars in panel.values() for group in bars))
    heights = [height for panel in panels.values() for bars in panel.values() for height, _ in bars.values()]
    if not heights:
        raise ValueError("plot_bars needs at least one bar.")
    bottom, top = _log_range(heights)
    wide = max(3.2, 1.2 + 0.22 * len(groups) * (len(models) + 1))
    in_a_row = wide * len(panels) <= _WIDEST
    rows, columns = (1, len(panels)) if in_a_row else (len(panels), 1)
    figure = new_figure((max(6.0, wide * columns), 2.6 * rows + 0.1 * len(models) + 0.4))
    width = 0.84 / len(models)
    for axes, (title, panel) in zip(figure.subplots(rows, columns, squeeze=False).flat, panels.items(), strict=True):
        for number, model in enumerate(models):
            look = {"color": series_color(number), "alpha": 0.9 if number < len(SERIES) else 0.45}  # colours repeat
            axes.bar(0, 0, label=model, **look)
            for group, (height, half_range) in panel.get(model, {}).items():
                x = groups.index(group) + (number - (len(models) - 1) / 2) * width
                known = math.isfinite(height)
                axes.bar(x, max(height, bottom) if known else top, width, hatch=None if known else "//", **look)
                if known and half_range > 0:
                    axes.errorbar(x, height, min(half_range, 0.999 * height), color=INK, linewidth=1)
        _frame_bars(axes, title, groups, (bottom, top), horizontal=6)
        if not in_a_row or axes is figure.axes[0]:
            axes.set_ylabel(ylabel, fontsize=8)
    legend_below(figure.axes[0], min(4, len(models)))
    return save(figure, path)


def _band(axes: Axes, x, low: np.ndarray, middle: np.ndarray, high: np.ndarray, color: str, label: str) -> None:
    axes.fill_between(x, low, high, color=color, alpha=0.15, linewidth=0)
    axes.plot(x, middle, color=color, label=label, linewidth=1.6)


def _finish(axes: Axes, xlabel: str, ylabel: str, path: str | os.PathLike) -> Path:
    axes.set(xlabel=xlabel, ylabel=ylabel)
    axes.legend(frameon=False, fontsize=9)
    clean(axes)
    return save(cast("Figure", axes.figure), path)


def _log_range(heights: Iterable[float]) -> tuple[float, float]:
    """Return bottom and top of a logarithmic axis of bars, with 1 between them."""
    finite = [height for height in heights if math.isfinite(height) and height > 0] + [1.0]
    return 10.0 ** math.floor(math.log10(0.8 * min(finite))), 3 * max(finite)


def _frame_bars(axes: Axes, title: str, groups: Collection[str], limits: tuple[float, float], horizontal: int) -> None:
    """Frame bars and draw a dashed line at 1; slant group names if there are more than ``horizontal``."""
    axes.axhline(1.0, color=INK, linestyle="--", linewidth=1)
    axes.set_xticks(range(len(groups)), list(groups), rotation=30 if len(groups) > horizontal else 0, fontsize=9)
    axes.set_title(title, fontsize=10)
    axes.set(xlim=(-0.6, len(groups) - 0.4), yscale="log", ylim=limits)
    clean(axes)
