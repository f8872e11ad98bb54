"""Trajectories of a robot's log: cut where it breaks, at even steps, with a report of what was dropped."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_gn.data.robot_log import RobotLog, short_way
from torchrl_gn.scenes.kinematic_tree import tree_states


@dataclass(frozen=True)
class LogReport:
    """What became of a log's rows.

    Attributes:
        rows: rows that were read.
        episodes: episodes that were read.
        kept: transitions in the trajectories that were made of it.
        trajectories: number of these.
        jumps: places where an angle moved as its velocity says it cannot have, by (episode, row before it).
        gaps: places where rows are missing or times not later, likewise; None: there are no time stamps to tell.
        not_finite: rows with a number that is not finite.
        short: rows that were left over, in pieces too short for a trajectory.
        timestep: step of the trajectories, seconds.
        interpolated: whether states lie between rows, which are not where the steps are.
        constant: commands that never vary, of which nothing can be learned.
        unread: what else was in the file, and why it was not read, by name.
    """

    rows: int
    episodes: int
    kept: int
    trajectories: int
    jumps: tuple[tuple[int, int], ...]
    gaps: tuple[tuple[int, int], ...] | None
    not_finite: int
    short: int
    timestep: float
    interpolated: bool
    constant: tuple[int, ...] = ()
    unread: dict[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        made = f"{self.trajectories:,} trajectories, {self.kept:,} transitions"
        gaps = "no time stamps: gaps show as jumps alone" if self.gaps is None else _cuts("gaps", self.gaps)
        lines = [
            f"{self.rows:,} rows in {self.episodes:,} episodes: {made}",
            f"  {_cuts('jumps', self.jumps)}",
            f"  {gaps}",
            f"  dropped {self.not_finite:,} rows that are not finite, {self.short:,} rows of pieces too short",
        ]
        if self.interpolated:
            lines.append(f"  interpolated between rows, at steps of {1e3 * self.timestep:g} ms")
        if self.constant:
            lines.append(
                f"  commands that never vary: {', '.join(map(str, self.constant))}; no model learns what they do"
            )
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
) -> tuple[TensorDict, LogReport]:
    """Trajectories of equal length from a log, none across a gap, a jump or two episodes.

    States are taken at even steps, from the first row of every unbroken piece on. Where a step falls on a row it is
    that row. Between rows, as where these are not evenly apart or ``resample`` is no multiple of the log's step, angles
    (the short way round), velocities and further channels are interpolated linearly. The command of a step is the mean
    over it of what was in force; each command holds until the next row.

    Args:
        log: the log.
        steps: transitions in each trajectory.
        resample: time step of the trajectories, seconds; default: the log's own.
        lag: rows of the log by which a command is delayed: paired with a state is the command of so many rows before.
        jump: a change of an angle that its velocities do not explain counts as a jump if it is so many times larger
            than such changes usually are (their 90 % quantile), and larger than what the largest logged velocity
            explains.
        overlap: let trajectories begin at every step, for training; by default each row is in one at most.
        episodes: which episodes to take; default: all.

    Returns:
        TensorDict ``[M]`` of ``state`` ``[M, steps + 1, J + 1, 3 + extras]`` and ``action`` ``[M, steps, A]``,
        float64, and ``episode`` ``[M]``, and the report of what was dropped.

    Raises:
        ValueError: if an option does not fit, or no trajectory is left.
    """
    if steps < 1 or lag < 0 or not jump > 0:
        raise ValueError(f"steps={steps}, lag={lag}, jump={jump}: steps from 1, a lag from 0, a jump above 0.")
    chosen = list(range(len(log.length))) if episodes is None else [int(episode) for episode in episodes]
    pace, at, finite, gaps, jumps = _pace(log, resample), log.at, log.finite, log.gaps, log.jumps(jump)
    channels = np.stack((log.angle, log.velocity, *log.extra.values()), 1)
    states, actions, which, used = [], [], [], 0
    for episode, start, stop in _pieces(log, chosen, gaps | jumps, finite):
        rows = slice(start + lag, stop)
        count = int((at[stop - 1] - at[start + lag]) / pace + 1e-9) if start + lag < stop else 0  # against rounding
        if count < steps:
            continue
        here, grid = at[rows] - at[start + lag], pace * np.arange(count + 1)
        (angle, velocity, *extras), needed = _interpolated(here, channels[rows], grid)
        state, command = tree_states(angle, velocity, extras), _held(here, log.command[start : stop - lag], grid)
        begin = np.arange(0, count - steps + 1, 1 if overlap else steps)
        window = begin[:, None] + np.arange(steps + 1)
        states.append(state[window])
        actions.append(command[window[:, :-1]])
        which.append(np.full(len(begin), episode))
        used += lag + int(needed[window[-1, -1]])
    low, high = log.command_bounds()
    made, whole = sum(map(len, which)), int(log.length[chosen].sum())
    dropped = whole - int(finite[np.isin(np.repeat(np.arange(len(log.length)), log.length), chosen)].sum())
    report = LogReport(
        rows=whole,
        episodes=len(chosen),
        kept=made * steps,
        trajectories=made,
        jumps=_places(jumps, log, chosen),
        gaps=None if log.time is None else _places(gaps, log, chosen),
        not_finite=dropped,
        short=whole - dropped - used,
        timestep=pace * log.timestep,
        interpolated=not log.even or pace != round(pace),
        constant=tuple(np.flatnonzero(low == high).tolist()),
        unread=log.unread,
    )
    if not made:
        raise ValueError(
            f"No piece of the log has {steps} transitions of {1e3 * report.timestep:g} ms; take fewer.\n{report}"
        )
    data = {"state": np.concatenate(states), "action": np.concatenate(actions), "episode": np.concatenate(which)}
    return TensorDict({key: torch.from_numpy(value) for key, value in data.items()}, batch_size=[made]), report


def _pace(log: RobotLog, resample: float | None) -> float:
    """Steps of the log in one of the trajectories: a whole number where it is one but for rounding."""
    if resample is None:
        return 1.0
    if not 0 < resample < np.inf:
        raise ValueError(f"resample={resample} must be a time step, in seconds.")
    pace = resample / log.timestep
    return float(round(pace)) if np.isclose(pace, max(1, round(pace)), rtol=1e-6) else pace


def _pieces(
    log: RobotLog, episodes: Sequence[int], breaks: np.ndarray, finite: np.ndarray
) -> Iterator[tuple[int, int, int]]:
    """Unbroken pieces of episodes: the episode, the first row, and the row behind the last one."""
    begins = log.begins
    for episode in episodes:
        start, last = int(begins[episode]), int(begins[episode + 1])
        # A piece ends at a row after which the log breaks, and at rows that are not finite.
        stops = start + np.r_[np.flatnonzero(breaks[start : last - 1]) + 1, np.flatnonzero(~finite[start:last])]
        for stop in [*np.unique(stops).tolist(), last]:
            yield episode, start, stop
            start = stop + (stop < last and not finite[stop])


def _places(found: np.ndarray, log: RobotLog, episodes: Sequence[int]) -> tuple[tuple[int, int], ...]:
    """Where something was found between two rows, by (episode, row in it)."""
    begins = log.begins
    each = ((episode, np.flatnonzero(found[begins[episode] : begins[episode + 1] - 1])) for episode in episodes)
    return tuple((episode, int(row)) for episode, rows in each for row in rows)


def _interpolated(at: np.ndarray, channels: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values on a grid, between rows linearly.

    Args:
        at: ``[n]`` where the rows lie, increasing from 0.
        channels: ``[n, C, J]`` their values, the first an angle.
        grid: ``[K + 1]`` where values are wanted, within the rows.

    Returns:
        ``[C, K + 1, J]`` values, exactly a row's where the grid meets it; ``[K + 1]`` rows needed up to there.
    """
    row = np.searchsorted(at, grid, side="right") - 1
    after = np.minimum(row + 1, len(at) - 1)
    share = (grid - at[row]) / np.where(after > row, at[after] - at[row], 1)
    change = channels[after] - channels[row]
    change[:, 0] = short_way(change[:, 0])
    values = channels[row] + share[:, None, None] * change
    return np.moveaxis(values, 1, 0), np.where(share > 0, after, row) + 1


def _held(at: np.ndarray, command: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Mean ``[K, A]`` over each step of a grid ``[K + 1]`` of commands ``[n, A]`` that hold until the next row."""
    first = np.searchsorted(at, grid[:-1], side="right") - 1
    last = np.searchsorted(at, grid[1:], side="left") - 1
    rows = np.minimum(first[:, None] + np.arange((last - first).max() + 1), len(at) - 1)
    ends = np.minimum(np.r_[at[1:], np.inf][rows], grid[1:, None])
    held = np.maximum(ends - np.maximum(at[rows], grid[:-1, None]), 0)
    return (command[rows] * held[..., None]).sum(1) / (grid[1] - grid[0])
