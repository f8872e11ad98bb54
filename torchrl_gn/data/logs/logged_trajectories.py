"""Trajectories at even time steps from a robot's log, and a report of dropped rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_gn.checks import check_count
from torchrl_gn.data.logs.log_noise import smoothed
from torchrl_gn.data.logs.robot_log import RobotLog, pieces, short_way
from torchrl_gn.scenes.kinematic_tree import tree_states


@dataclass(frozen=True)
class LogReport:
    """Statistics of :func:`log_trajectories`."""

    rows: int
    episodes: int
    kept: int  # transitions in the trajectories
    trajectories: int
    jumps: tuple[tuple[int, int], ...]  # (episode, row before the jump): velocities do not explain it
    gaps: tuple[tuple[int, int], ...] | None  # (episode, row before the gap); None without time stamps
    not_finite: int  # rows with numbers that are not finite
    short: int  # rows of pieces too short for a trajectory
    timestep: float  # of the trajectories, seconds
    interpolated: bool
    constant: tuple[int, ...] = ()  # commands that never vary
    unread: dict[str, str] = field(default_factory=dict)  # reason for each array of the file that was not read

    def __str__(self) -> str:
        summary = f"{self.trajectories:,} trajectories, {self.kept:,} transitions"
        gaps = "no time stamps: only jumps show gaps" if self.gaps is None else _cuts("gaps", self.gaps)
        lines = [
            f"{self.rows:,} rows in {self.episodes:,} episodes: {summary}\n  {_cuts('jumps', self.jumps)}\n  {gaps}",
            f"  dropped {self.not_finite:,} rows that are not finite, {self.short:,} rows of pieces too short",
        ]
        if self.interpolated:
            lines.append(f"  interpolated between rows, at steps of {1e3 * self.timestep:g} ms")
        if self.constant:
            constant = ", ".join(map(str, self.constant))
            lines.append(f"  commands that never vary: {constant}; no model learns what they do")
        lines += [f"  not read: {name!r}, {why}" for name, why in self.unread.items()]
        return "\n".join(lines)


def _cuts(what: str, places: tuple[tuple[int, int], ...]) -> str:
    first = f", the first at row {places[0][1]} of episode {places[0][0]}" if places else ""
    return f"cut at {len(places):,} {what}{first}"


def log_trajectories(
    log: RobotLog,
    steps: int,
    *,
    resample: float | None = None,
    lag: int = 0,
    jump: float = 50.0,
    overlap: bool = False,
    episodes: Sequence[int] | np.ndarray | None = None,
    history: int = 0,
    smooth: int | Mapping[str, int] = 0,
) -> tuple[TensorDict, LogReport]:
    """Cut a log into trajectories of equal length that cross no gap, jump, end of an episode or non-finite row.

    States are interpolated linearly between rows; an action is the mean of the commands over a step.

    Args:
        resample: time step of the trajectories, seconds; default: the log's.
        lag: delay of the commands, in rows.
        jump: threshold of a jump. An angle jumps if the part of its change that velocities do not explain exceeds both
            ``jump`` times its 90 % quantile and the change at the largest logged velocity.
        overlap: start trajectories at every step; default: no two overlap.
        episodes: indices of the episodes to use; default: all.
        history: number of past steps whose commands an action includes, ``A = (history + 1) * commands``, the latest
            first; for feed-forward models of motors that lag. Give :func:`log_tree` the same number.
        smooth: rows to each side over which training targets are smoothed (zero-phase, local parabolas), by channel
            (:attr:`LogInspection.half_widths`) or for all. ``state`` stays as logged; :func:`trajectory_buffer` reads
            next states from the extra entry ``smoothed``.

    Returns:
        TensorDict ``[M]``, float64, of ``state`` ``[M, steps + 1, J + 1, 3 + extras]``, ``action`` ``[M, steps, A]``,
        integer ``episode`` ``[M]``, ``timestep`` ``[M]`` in seconds and, if asked for, ``smoothed`` like ``state``; and
        the report.

    Raises:
        ValueError: if an option is out of range, ``episodes`` is a mask, has an episode twice or one that the log
            lacks, or no piece of the log is long enough.
    """
    for name, value, least in (("steps", steps, 1), ("lag", lag, 0), ("history", history, 0)):
        check_count(name, value, least)
    if not jump > 0:
        raise ValueError(f"jump={jump} must be above 0.")
    chosen = chosen_episodes(episodes, len(log.length))
    stride, at, finite, gaps, jumps = _stride(log, resample), log.at, log.finite, log.gaps, log.jumps(jump)
    names, channels = ("angle", "velocity", *log.extra), np.stack((log.angle, log.velocity, *log.extra.values()), 1)
    half = dict(smooth) if isinstance(smooth, Mapping) else dict.fromkeys(names, smooth)
    if half.keys() - set(names):
        raise ValueError(f"smooth={smooth} must be rows of at least 0, by channel of {names} or for all.")
    for name, rows in half.items():
        check_count(f"smooth of {name}", rows, 0)
    states, actions, targets, which, used = [], [], [], [], 0
    for episode, start, stop in pieces(log, chosen, gaps | jumps, finite):
        rows = slice(start + lag, stop)
        count = int((at[stop - 1] - at[start + lag]) / stride + 1e-9) if start + lag < stop else 0  # tolerates rounding
        if count < steps + history:
            continue
        here, grid = at[rows] - at[start + lag], stride * np.arange(count + 1)
        state, needed = _states(here, channels[rows], grid)
        command = _mean_commands(here, log.command[start : stop - lag], grid)
        command = np.hstack([command[history - past : count - past] for past in range(history + 1)])
        begin = np.arange(history, count - steps + 1, 1 if overlap else steps)
        window = begin[:, None] + np.arange(steps + 1)
        states.append(state[window])
        actions.append(command[window[:, :-1] - history])
        if any(half.values()):
            filtered = _smoothed(here, channels[rows], [half.get(name, 0) for name in names])
            targets.append(_states(here, filtered, grid)[0][window])
        which.append(np.full(len(begin), episode))
        used += lag + int(needed[window[-1, -1]])
    low, high = log.command_bounds()
    num_trajectories, num_rows = sum(map(len, which)), int(log.length[chosen].sum())
    dropped = num_rows - int(finite[np.isin(np.repeat(np.arange(len(log.length)), log.length), chosen)].sum())
    report = LogReport(
        rows=num_rows,
        episodes=len(chosen),
        kept=num_trajectories * steps,
        trajectories=num_trajectories,
        jumps=_places(jumps, log, chosen),
        gaps=None if log.time is None else _places(gaps, log, chosen),
        not_finite=dropped,
        short=num_rows - dropped - used,
        timestep=stride * log.timestep,
        interpolated=not log.even or stride != round(stride),
        constant=tuple(np.flatnonzero(low == high).tolist()),
        unread=log.unread,
    )
    if not num_trajectories:
        step = f"{1e3 * report.timestep:g} ms"
        before = f" after {history} of history" if history else ""
        raise ValueError(f"No piece of the log has {steps} transitions of {step}{before}; take fewer.\n{report}")
    parts = {"state": states, "action": actions, "episode": which} | ({"smoothed": targets} if targets else {})
    entries = {key: torch.from_numpy(np.concatenate(part)) for key, part in parts.items()}
    entries["timestep"] = torch.full((num_trajectories,), report.timestep, dtype=torch.float64, device="cpu")
    return TensorDict(entries, batch_size=[num_trajectories]), report


def chosen_episodes(episodes: Sequence[int] | np.ndarray | None, count: int) -> list[int]:
    """Return the chosen episodes' indices, by default all ``count``; ValueError for a mask or a missing episode."""
    if episodes is None:
        return list(range(count))
    indices = np.asarray(episodes).reshape(-1).tolist()
    if any(isinstance(episode, bool) for episode in indices):
        raise ValueError("episodes must be indices, not a mask: give np.flatnonzero of it.")
    if wrong := [each for each in indices if not isinstance(each, int | np.integer) or not 0 <= each < count]:
        raise ValueError(
            f"episodes must be whole numbers from 0 to {count - 1}, the last of the log; got {wrong[0]!r}."
        )
    if len(set(indices)) < len(indices):
        twice = next(episode for episode in indices if indices.count(episode) > 1)
        raise ValueError(f"episodes has {twice} more than once.")
    return indices


def _stride(log: RobotLog, resample: float | None) -> float:
    """Return the trajectories' time step in steps of the log, rounded if almost whole."""
    if resample is None:
        return 1.0
    if not 0 < resample < np.inf:
        raise ValueError(f"resample={resample} must be a time step above 0, in seconds.")
    stride = resample / log.timestep
    return float(round(stride)) if np.isclose(stride, max(1, round(stride)), rtol=1e-6) else stride


def _places(found: np.ndarray, log: RobotLog, episodes: Sequence[int]) -> tuple[tuple[int, int], ...]:
    begins = log.begins
    each = ((episode, np.flatnonzero(found[begins[episode] : begins[episode + 1] - 1])) for episode in episodes)
    return tuple((episode, int(row)) for episode, rows in each for row in rows)


def _states(at: np.ndarray, channels: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    (angle, velocity, *extras), needed = _interpolated(at, channels, grid)
    return tree_states(angle, velocity, extras), needed


def _smoothed(at: np.ndarray, channels: np.ndarray, half: Sequence[int]) -> np.ndarray:
    """Smooth channels ``[n, C, J]``, the first an angle, each over its own number of rows to each side."""
    angle = np.unwrap(channels[:, :1], axis=0)
    series = np.concatenate((angle, channels[:, 1:]), 1)
    return np.stack([smoothed(at, series[:, index], rows)[0] for index, rows in enumerate(half)], 1)


def _interpolated(at: np.ndarray, channels: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate channels ``[n, C, J]``, the first an angle, to ``[C, K + 1, J]``; also count the rows read."""
    row = np.searchsorted(at, grid, side="right") - 1
    after = np.minimum(row + 1, len(at) - 1)
    share = (grid - at[row]) / np.where(after > row, at[after] - at[row], 1)
    change = channels[after] - channels[row]
    change[:, 0] = short_way(change[:, 0])
    values = channels[row] + share[:, None, None] * change
    return np.moveaxis(values, 1, 0), np.where(share > 0, after, row) + 1


def _mean_commands(at: np.ndarray, command: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Average commands ``[n, A]``, each held until the next row, over each step of a grid: ``[K, A]``."""
    first = np.searchsorted(at, grid[:-1], side="right") - 1
    last = np.searchsorted(at, grid[1:], side="left") - 1
    rows = np.minimum(first[:, None] + np.arange((last - first).max() + 1), len(at) - 1)
    end_times = np.minimum(np.r_[at[1:], np.inf][rows], grid[1:, None])
    held = np.maximum(end_times - np.maximum(at[rows], grid[:-1, None]), 0)
    return (command[rows] * held[..., None]).sum(1) / (grid[1] - grid[0])
