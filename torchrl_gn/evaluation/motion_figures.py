"""Figures of predicted and true motion over time. Each function writes one file and returns its path."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.drawing.canvas import AXES, INK, MUTED, PREDICTION, TRUTH, clean, legend_below, new_figure, save
from torchrl_gn.maths import quaternion
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.scenes import KinematicTree, Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_TRUE: dict[str, Any] = {"linewidth": 3.2, "alpha": 0.35}
_PREDICTED: dict[str, Any] = {"linewidth": 1.2, "linestyle": (0, (4, 1.5))}
_MEASURED: dict[str, Any] = {"color": TRUTH, "linewidth": 3.2, "alpha": 0.4}
_PANELS = (
    ("position", "position [m]", "xyz"),
    ("orientation", "orientation quaternion", "wxyz"),
    ("linear_velocity", "linear velocity [m/s]", "xyz"),
    ("angular_velocity", "angular velocity [rad/s]", "xyz"),
)


def plot_body_trajectory(
    truth: Tensor, prediction: Tensor, scene: Scene, path: str | os.PathLike, *, node: int | str | None = None
) -> Path:
    """Plot predicted and true states ``[T + 1, N, 13]`` of one body (paper, "Evaluation rollout in a Swimmer6").

    Values that are not finite leave gaps. ``node`` is an index or a name; default: the middle one of the moving nodes,
    such as link 3 of Swimmer6.
    """
    if truth.ndim != 3 or truth.shape != prediction.shape or truth.shape[1:] != (scene.num_nodes, scene.state_size):
        shapes = f"[T + 1, {scene.num_nodes}, {scene.state_size}], got {list(truth.shape)} and {list(prediction.shape)}"
        raise ValueError(f"Truth and prediction of scene {scene.name!r} must both be {shapes}.")
    index = node_index(scene, node)
    true, predicted = (states[:, index].detach().double().cpu().numpy() for states in (truth, prediction))
    true, predicted = align_signs(true.copy(), predicted.copy(), BODY_STATE.slices["orientation"])
    time = np.arange(len(true)) * scene.timestep
    figure = new_figure((9.0, 5.6))
    for axes, (name, label, channels) in zip(figure.subplots(2, 2, sharex=True).flat, _PANELS, strict=True):
        values = BODY_STATE.slices[name]
        for channel, letter in enumerate(channels):
            color = AXES["xyzw".index(letter)]
            axes.plot(time, true[:, values][:, channel], color=color, **_TRUE)
            axes.plot(time, predicted[:, values][:, channel], color=color, **_PREDICTED)
            axes.plot([], [], color=color, label=letter)
        _widen(axes, np.concatenate((true[:, values], predicted[:, values])))
        axes.set_title(label, loc="left", fontsize=10, color=INK)
        axes.legend(ncols=len(channels), fontsize=8, frameon=False, loc="lower right", bbox_to_anchor=(1.01, 0.98))
        axes.margins(x=0.01)
        clean(axes)
    for axes in figure.axes[2:]:
        axes.set_xlabel("time [s]", fontsize=9)
    figure.suptitle(f"{scene.name}, {scene.node_names[index]}: truth (wide, pale) and prediction (dashed)", fontsize=11)
    return save(figure, path)


def plot_band(
    truth: Tensor, mean: Tensor, std: Tensor, scene: Scene, path: str | os.PathLike, *, node: int | str | None = None
) -> Path:
    """Plot one body's true states, and an ensemble's prediction with bands of one and two standard deviations.

    Args:
        truth: true states ``[T + 1, N, 13]``.
        mean: predicted states ``[T + 1, N, 13]``.
        std: standard deviations ``[T + 1, N, 12]`` of the prediction.
        scene: the scene of the states.
        path: file of the figure.
        node: the body, see :func:`plot_body_trajectory`.
    """
    if truth.shape != mean.shape or truth.shape[1:] != (scene.num_nodes, scene.state_size):
        shapes = f"[T + 1, {scene.num_nodes}, {scene.state_size}], got {list(truth.shape)} and {list(mean.shape)}"
        raise ValueError(f"Truth and mean of scene {scene.name!r} must both be {shapes}.")
    index = node_index(scene, node)
    true, middle, size = (each[:, index].detach().double().cpu().numpy() for each in (truth, mean, std))
    time = np.arange(len(true)) * scene.timestep
    figure = new_figure((9.0, 3.4))
    panels = [panel for panel in _PANELS if panel[0] in ("position", "linear_velocity")]
    for axes, (name, label, channels) in zip(figure.subplots(1, 2), panels, strict=True):
        where, std_columns = BODY_STATE.slices[name], BODY_STATE.delta_slices[name]
        for channel, letter in enumerate(channels):
            color, center = AXES[channel], middle[:, where][:, channel]
            _band(axes, time, center, size[:, std_columns][:, channel], color)
            axes.plot(time, true[:, where][:, channel], color=color, linewidth=1.6, label=letter)
            axes.plot(time, center, color=color, **_PREDICTED)
        _widen(axes, np.concatenate((true[:, where], middle[:, where])))
        axes.set_title(label, loc="left", fontsize=10, color=INK)
        axes.set_xlabel("time [s]", fontsize=9)
        axes.legend(ncols=len(channels), fontsize=8, frameon=False, loc="lower right", bbox_to_anchor=(1.01, 0.98))
        axes.margins(x=0.01)
        clean(axes)
    title = "truth (lines) and prediction (dashed) with one and two standard deviations"
    figure.suptitle(f"{scene.name}, {scene.node_names[index]}: {title}", fontsize=11)
    return save(figure, path)


def plot_motions(
    panels: Mapping[str, tuple[Tensor, Tensor]],
    scene: Scene,
    path: str | os.PathLike,
    *,
    labels: Sequence[str],
    node: int | str | None = None,
) -> Path:
    """Plot true and predicted rotation of one body in several systems (paper, figure "System identification analysis").

    Args:
        panels: true states ``[S, T + 1, N, 13]`` and predicted states ``[S, H + 1, N, 13]`` of their last ``H + 1``
            steps, by title.
        labels: names of the ``S`` systems.
    """
    index, where = node_index(scene, node), BODY_STATE.slices["orientation"]
    figure = new_figure((4.6 * len(panels) + 0.4, 3.6))
    for axes, (title, (truth, prediction)) in zip(
        figure.subplots(1, len(panels), squeeze=False, sharey=True)[0], panels.items(), strict=True
    ):
        first = truth.shape[1] - prediction.shape[1]
        for system, label in enumerate(labels):
            color = AXES[system % len(AXES)]
            start = truth[system, :1, index, where]
            relative = quaternion.product(quaternion.conjugate(start), truth[system, :, index, where])
            main, true = int(relative[:, 1:].square().sum(0).argmax()), np.zeros(0)
            for states, offset, look in ((truth, 0, _TRUE), (prediction, first, {**_PREDICTED, "label": label})):
                rotated = rotation_angle(states[system, :, index, where], start, main)
                if offset:  # count whole revolutions as the truth does where the prediction begins
                    rotated = rotated + 2 * np.pi * round((true[offset] - rotated[0]) / (2 * np.pi))
                else:
                    true = rotated
                axes.plot((offset + np.arange(len(rotated))) * scene.timestep, rotated, color=color, **look)
        axes.axvline(first * scene.timestep, color=MUTED, linewidth=1)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("time [s]", fontsize=9)
        axes.legend(frameon=False, fontsize=8)
        clean(axes)
    figure.axes[0].set_ylabel(f"{scene.node_names[index]} has rotated [rad]", fontsize=9)
    return save(figure, path)


def rotation_angle(orientation: Tensor, start: Tensor, axis: int) -> np.ndarray:
    """Return the unwrapped angle ``[T]``, radians, about an axis since a start orientation."""
    relative = quaternion.product(quaternion.conjugate(start), orientation)
    return np.unwrap(2 * torch.atan2(relative[:, 1 + axis], relative[:, 0]).detach().cpu().numpy())


def plot_joints(
    truth: Tensor,
    predictions: Mapping[str, Tensor],
    scene: KinematicTree,
    path: str | os.PathLike,
    *,
    joints: Sequence[int] | None = None,
    stds: Mapping[str, Tensor] | None = None,
) -> Path:
    """Plot predicted and measured joint angles and velocities (paper, figure "Real and predicted test trajectories").

    Args:
        truth: ``[T + 1, N, 3 + extras]`` measured states of a robot known by its joints.
        predictions: predicted states of the last ``H + 1`` steps by the model's name.
        joints: joints to show. Default: the first four.
        stds: standard deviations ``[H + 1, N, 2 + extras]`` of some predictions; bands show one and two of them.
    """
    stds = stds or {}
    joints = list(range(min(4, scene.num_joints))) if joints is None else list(joints)

    def angles(states: Tensor) -> np.ndarray:
        return np.unwrap(torch.atan2(states[:, 1], states[:, 0]).detach().cpu().numpy())

    def velocities(states: Tensor) -> np.ndarray:
        return states[:, 2].detach().cpu().numpy()

    figure = new_figure((2.9 * len(joints) + 0.8, 4.8))
    grid = figure.subplots(2, len(joints), squeeze=False, sharex=True)
    colors = (PREDICTION, *AXES)
    for column, joint in enumerate(joints):
        for channel, (axes, read) in enumerate(zip(grid[:, column], (angles, velocities), strict=True)):
            true = read(truth[:, joint + 1])
            axes.plot(np.arange(len(true)) * scene.timestep, true, **_MEASURED)
            for number, (name, states) in enumerate(predictions.items()):
                values, first = read(states[:, joint + 1]), len(truth) - len(states)
                time = (first + np.arange(len(values))) * scene.timestep
                color = colors[number % len(colors)]
                axes.plot(time, values, color=color, linewidth=1.3, label=name)
                if name in stds:
                    _band(axes, time, values, stds[name][:, joint + 1, channel].double().cpu().numpy(), color)
                axes.axvline(first * scene.timestep, color=MUTED, linewidth=0.8)
            clean(axes)
        grid[0, column].set_title(scene.joint_names[joint], fontsize=10)
        grid[1, column].set_xlabel("time [s]", fontsize=9)
    grid[0, 0].set_ylabel("angle [rad]", fontsize=9)
    grid[1, 0].set_ylabel("velocity [rad/s]", fontsize=9)
    grid[0, 0].plot([], [], label="measured", **_MEASURED)
    legend_below(grid[0, 0], 4)
    return save(figure, path)


def node_index(scene: Scene, node: int | str | None) -> int:
    """Return the index of a node given by index or name; default: the middle one of the moving nodes."""
    if node is None:
        if not len(moving := np.flatnonzero(scene.predicted)):
            raise ValueError(f"Nothing moves in scene {scene.name!r}.")
        return int(moving[(len(moving) - 1) // 2])
    if isinstance(node, str):
        if node not in scene.node_names:
            raise ValueError(f"Scene {scene.name!r} has no node {node!r}, only {list(scene.node_names)}.")
        return scene.node_names.index(node)
    if not 0 <= node < scene.num_nodes:
        raise ValueError(f"Scene {scene.name!r} has nodes 0 to {scene.num_nodes - 1}, not {node}.")
    return node


def align_signs(true: np.ndarray, predicted: np.ndarray, where: slice) -> tuple[np.ndarray, np.ndarray]:
    """Choose signs of quaternions without jumps over time, and the same sign for prediction and truth."""
    q, p = true[:, where], predicted[:, where]
    # The product of all sign changes so far undoes every jump between q and -q.
    jumps = np.where((q[1:] * q[:-1]).sum(-1) < 0, -1.0, 1.0)
    q[1:] *= np.cumprod(jumps)[:, None]
    p *= np.where(np.nan_to_num(p * q).sum(-1) < 0, -1.0, 1.0)[:, None]
    return true, predicted


def _band(axes: Axes, time: np.ndarray, center: np.ndarray, std: np.ndarray, color: str) -> None:
    """Shade one and two standard deviations about a line."""
    for width, alpha in ((2, 0.12), (1, 0.2)):
        axes.fill_between(time, center - width * std, center + width * std, color=color, alpha=alpha, linewidth=0)


def _widen(axes: Axes, values: np.ndarray) -> None:
    """Keep a panel without motion from zooming into rounding errors."""
    finite = values[np.isfinite(values)]
    if finite.size and np.ptp(finite) < 1e-6:
        axes.set_ylim(finite.mean() - 0.1, finite.mean() + 0.1)
