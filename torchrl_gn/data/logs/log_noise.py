"""Noise of a log's channels, and zero-phase smoothing, by local polynomials."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import cast

import numpy as np
import torch
from tensordict import TensorDictBase

from torchrl_gn.data.logs.robot_log import RobotLog

_HALF_WIDTHS = (2, 3, 4, 6, 8, 12, 16)  # candidates for the rows to each side when smoothing
_ROWS = 20_000  # approximate number that noise is estimated from


def smoothed(at: np.ndarray, values: np.ndarray, half: int, order: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Fit a polynomial to the rows around each row (Savitzky-Golay, for uneven rows too).

    Args:
        at: times ``[n]``.
        values: ``[n, ...]``, without jumps; returned as they are if ``n`` is too small.
        half: rows to each side; near the ends the window keeps its size and extends further to one side.

    Returns:
        Smoothed values ``[n, ...]``, and each row's weight in its own value ``[n]``.
    """
    half = min(half, (len(at) - 1) // 2)
    if 2 * half <= order:
        return values, np.ones(len(at))
    rows = np.clip(np.arange(len(at)) - half, 0, len(at) - 1 - 2 * half)[:, None] + np.arange(2 * half + 1)
    basis = ((at[rows] - at[:, None]) / (at[rows[:, -1:]] - at[rows[:, :1]]))[..., None] ** np.arange(order + 1)
    transposed = basis.swapaxes(1, 2)
    weights = np.linalg.solve(transposed @ basis, transposed)[:, 0]  # [n, 2 half + 1], of each row in the fitted value
    center_weight = np.take_along_axis(weights, np.arange(len(at))[:, None] - rows[:, :1], 1)[:, 0]
    return np.einsum("nw,nw...->n...", weights, values[rows]), center_weight


def channel_noise(log: RobotLog, pieces: Sequence[slice]) -> dict[str, np.ndarray]:
    """Estimate the standard deviation ``[J]`` of the noise of angles, velocities and further channels.

    The noise is the smallest residual of local cubic fits over 5, 7 or 9 rows: cubics follow the motion over so few
    rows. The result is NaN if all pieces are shorter.
    """
    channels = _channels(log)
    squares = np.full((3, len(channels), log.num_joints), np.inf)
    for index, half in enumerate((2, 3, 4)):
        residuals = [
            (values - fit) / np.sqrt(1 - center_weight)[:, None, None]
            for at, values in _sample(log, pieces, 2 * half + 1)
            for fit, center_weight in [smoothed(at, values, half, order=3)]
        ]
        if residuals:
            squares[index] = np.mean(np.square(np.concatenate(residuals)), axis=0)
    noise = np.sqrt(squares.min(0))
    return dict(zip(channels, np.where(np.isinf(noise), np.nan, noise), strict=True))


def half_widths(log: RobotLog, pieces: Sequence[slice], noise: dict[str, np.ndarray]) -> dict[str, int]:
    """Choose each channel's half-width of smoothing, in rows, by Mallows' Cp; 0 if smoothing does not help."""
    variance = np.square(np.stack(list(noise.values())))[None]
    best = np.array([np.full(len(noise), 2.0)])  # Cp without smoothing: residual 0, own weight 1
    for half in _HALF_WIDTHS:
        terms = [
            np.square(values - fit) / np.maximum(variance, 1e-30) + 2 * center_weight[:, None, None]
            for at, values in _sample(log, pieces, 2 * half + 1)
            for fit, center_weight in [smoothed(at, values, half)]
        ]
        risk = np.concatenate(terms).mean((0, 2)) if terms else np.full(len(noise), np.inf)
        best = np.vstack((best, risk))
    return dict(zip(noise, np.array([0, *_HALF_WIDTHS])[best.argmin(0)].tolist(), strict=True))


def _channels(log: RobotLog) -> dict[str, np.ndarray]:
    return {"angle": log.angle, "velocity": log.velocity, **log.extra}


def _sample(log: RobotLog, pieces: Sequence[slice], rows: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield times ``[n]`` and channels ``[n, C, J]`` of evenly chosen pieces with at least ``rows`` rows."""
    long = [piece for piece in pieces if piece.stop - piece.start >= rows]
    total, at, channels = sum(piece.stop - piece.start for piece in long), log.at, list(_channels(log).values())
    for piece in long[:: max(1, total // _ROWS)]:
        piece = slice(piece.start, min(piece.stop, piece.start + _ROWS))
        angle, *others = (values[piece] for values in channels)
        yield at[piece], np.stack((np.unwrap(angle, axis=0), *others), 1)


def channel_weights(noise: Mapping[str, np.ndarray], trajectories: TensorDictBase) -> torch.Tensor:
    """Return weights for :class:`~torchrl_gn.objectives.ForwardModelLoss` that are smaller for noisier channels.

    A weight is ``1 / (1 + noise / change)``, at least 0.05. Here ``noise`` is the variance that noise adds to the
    change over a step, and ``change`` the variance of the true change.

    Args:
        noise: standard deviation ``[J]`` of each channel (:attr:`LogInspection.noise`).
        trajectories: output of :func:`log_trajectories`.

    Returns:
        Weights ``[J + 1, 2 + extras]``; the first node, the base, has weight 1.
    """
    state = cast(torch.Tensor, trajectories["state"])[:, :, 1:]
    angle = torch.atan2(state[..., 1], state[..., 0])
    change = torch.cat((angle[..., None], state[..., 2:]), -1).diff(dim=1)
    change[..., 0] = torch.remainder(change[..., 0] + torch.pi, 2 * torch.pi) - torch.pi
    measured = change.flatten(0, 1).var(0)
    share = 1 - 2 * torch.from_numpy(np.stack(list(noise.values()), 1)).square() / measured.clamp(min=1e-30)
    weights = share.nan_to_num(nan=1.0).clamp(min=0.05)
    return torch.cat((torch.ones_like(weights[:1]), weights))
