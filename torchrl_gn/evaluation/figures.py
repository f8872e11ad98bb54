"""Figures of numbers: errors, training, run time."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from torch import Tensor

from torchrl_gn.evaluation import palette
from torchrl_gn.evaluation.canvas import clean, new_figure, save
from torchrl_gn.evaluation.error_table import ErrorTable

_WIDEST = 12.0  # inches of panels side by side


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
    figure = new_figure((4.2 * len(panels) + 0.6, 3.8))
    colors = palette.SERIES
    for axes, (xlabel, lines) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
        for number, (label, (x, y)) in enumerate(lines.items()):
            axes.loglog(x, y, color=colors[number % len(colors)], label=label, linewidth=1.6, marker="o", markersize=4)
        counts = sorted({value for x, _ in lines.values() for value in x})
        if all(float(value).is_integer() for value in counts) and len(counts) < 10:
            axes.set_xticks(counts, [f"{value:,.0f}" for value in counts])  # of powers of ten labels may overlap
            axes.set_xticks([], minor=True)
        axes.set_xlabel(xlabel)
        axes.set_ylabel(ylabel)
        axes.grid(alpha=0.25, which="both")
        axes.legend(frameon=False)
    return save(figure, path)


def plot_rewards(
    rewards: Mapping[str, Tensor], path: str | os.PathLike, *, timestep: float, ylabel: str = "reward"
) -> Path:
    """Reward over time, a line for every planner or policy: the mean of its episodes, and pale from worst to best.

    Args:
        rewards: ``[B, T]`` by label; NaN where an episode was over.
        path: file to write; its suffix is the format.
        timestep: seconds of a control step.
        ylabel: name of the vertical axis.

    Returns:
        The written path.
    """
    figure = new_figure((6.4, 3.8))
    axes = figure.subplots()
    colors = palette.SERIES
    for number, (label, values) in enumerate(rewards.items()):
        values = values.detach().double().cpu().numpy()
        time, color = timestep * np.arange(1, values.shape[1] + 1), colors[number % len(colors)]
        going = np.isfinite(values).any(0)  # while there is one to draw
        time, values = time[going], values[:, going]
        low, high, middle = np.nanmin(values, 0), np.nanmax(values, 0), np.nanmean(values, 0)
        axes.fill_between(time, low, high, color=color, alpha=0.15, linewidth=0)
        axes.plot(time, middle, color=color, label=label, linewidth=1.6)
    axes.set_xlabel("time [s]")
    axes.set_ylabel(ylabel)
    axes.legend(frameon=False, fontsize=9)
    clean(axes)
    return save(figure, path)


def plot_planning_curves(
    curves: Mapping[str, tuple[Sequence[float], Sequence[float], Sequence[float]]], path: str | os.PathLike
) -> Path:
    """Rewards over planning time, on a logarithmic axis, with their spread as bars.

    Args:
        curves: milliseconds of planning a control step, mean rewards and their spread, ``[N]`` each, by label.
        path: file to write; its suffix is the format.

    Returns:
        The written path.
    """
    figure = new_figure((6.4, 3.8))
    axes = figure.subplots()
    style = {"linewidth": 1.6, "marker": "o", "markersize": 4, "elinewidth": 0.8, "capsize": 2}
    for number, (label, (times, rewards, spreads)) in enumerate(curves.items()):
        color = palette.SERIES[number % len(palette.SERIES)]
        axes.errorbar(times, rewards, yerr=spreads, color=color, label=label, **style)
    axes.set_xscale("log")
    axes.set_xlabel("planning a control step [ms]")
    axes.set_ylabel("mean reward of a step")
    axes.legend(frameon=False, fontsize=9)
    clean(axes)
    return save(figure, path)


def plot_learning_curves(
    curves: Mapping[str, tuple[Sequence[float], Sequence[Sequence[float]]]], path: str | os.PathLike
) -> Path:
    """Returns over environment steps: the median of the seeds, and pale their quartiles (paper, "Learning curves").

    Args:
        curves: environment steps ``[T]`` and returns ``[S, T]`` of ``S`` seeds by label.
        path: file to write; its suffix is the format.

    Returns:
        The written path.

    Raises:
        ValueError: if a seed has not as many returns as there are steps.
    """
    figure = new_figure((6.4, 3.8))
    axes = figure.subplots()
    colors = palette.SERIES
    for number, (label, (frames, returns)) in enumerate(curves.items()):
        if any(len(of) != len(frames) for of in returns):
            raise ValueError(
                f"Every seed of {label!r} must have {len(frames)} returns, got {[len(of) for of in returns]}."
            )
        low, median, high = np.quantile(np.asarray(returns, float), (0.25, 0.5, 0.75), axis=0)
        color = colors[number % len(colors)]
        axes.fill_between(frames, low, high, color=color, alpha=0.15, linewidth=0)
        axes.plot(frames, median, color=color, label=label, linewidth=1.6)
    axes.set_xlabel("environment steps")
    axes.set_ylabel("return of an episode")
    axes.legend(frameon=False, fontsize=9)
    clean(axes)
    return save(figure, path)


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

    figure = new_figure((7.0, 4.2))
    axes = figure.subplots()
    colors = palette.SERIES
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
    clean(axes)
    return save(figure, path)


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
    figure = new_figure((max(6.0, 1.5 + len(names) * (1.2 + 0.75 * len(tables))), 4.2))
    panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    shown = [t[name] for t in tables.values() for name in names]
    finite = [v for e in shown for v in (e.total, *e.components.values()) if math.isfinite(v) and v > 0] + [1.0]
    bottom, top = 10.0 ** math.floor(math.log10(0.8 * min(finite))), 3 * max(finite)
    components = dict.fromkeys(component for error in shown for component in error.components)
    markers = dict(zip(components, itertools.cycle("osD^v<>"), strict=False))
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
                    axes.plot(place, value, markers[component], color=palette.INK, markersize=4, markerfacecolor="w")
        axes.axhline(1.0, color=palette.INK, linestyle="--", linewidth=1)
        axes.set_xticks(range(len(tables)), tables.keys(), rotation=30 if len(tables) > 3 else 0, fontsize=9)
        axes.set_xlim(-0.6, len(tables) - 0.4)
        axes.set_title(name.replace("_error", "").replace("_", " "), fontsize=10)
        axes.set_yscale("log")
        axes.set_ylim(bottom, top)
        clean(axes)
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
    return save(figure, path)


def plot_bars(
    panels: Mapping[str, Mapping[str, Mapping[str, tuple[float, float]]]],
    path: str | os.PathLike,
    *,
    ylabel: str = "squared error / constant prediction's",
) -> Path:
    """Groups of bars on a logarithmic axis (paper, figure "One-step and rollout errors for different models").

    Panels side by side while they fit, else one below the other, in each a group for every system, in each group
    a bar for every model, with a dashed line at 1, the constant prediction. What is not finite reaches the top,
    hatched.

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
    wide = max(3.2, 1.2 + 0.22 * len(groups) * (len(models) + 1))
    beside = wide * len(panels) <= _WIDEST
    rows, columns = (1, len(panels)) if beside else (len(panels), 1)
    figure = new_figure((max(6.0, wide * columns), 2.6 * rows + 0.1 * len(models) + 0.4))
    colors = palette.SERIES
    width = 0.84 / len(models)
    for axes, (title, panel) in zip(figure.subplots(rows, columns, squeeze=False).flat, panels.items(), strict=True):
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
        if not beside or axes is figure.axes[0]:
            axes.set_ylabel(ylabel, fontsize=8)
        axes.set_title(title, fontsize=10)
        clean(axes)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(4, len(models)), fontsize=8, frameon=False)
    return save(figure, path)
