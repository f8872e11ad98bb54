"""Logs of real robot arms: joint angles, velocities and commands, checked, cut where they break, as trajectories."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_gn.data.errors import DatasetError
from torchrl_gn.scenes.joint_chain import JointChain, chain_states

_NEEDED = ("angle", "velocity", "command")


@dataclass(frozen=True, eq=False)
class RobotLog:
    """Joint-space log of an arm, row after row.

    Attributes:
        angle: ``[R, J]`` joint angles, radians.
        velocity: ``[R, J]`` joint velocities, rad/s.
        command: ``[R, A]`` commands given in each row's state.
        extra: further channels by name, ``[R, J]`` each.
        length: rows of each episode; they add up to ``R``.
        timestep: time between rows, seconds.
    """

    angle: np.ndarray
    velocity: np.ndarray
    command: np.ndarray
    length: np.ndarray
    timestep: float
    extra: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def num_joints(self) -> int:
        """Number of joints ``J``."""
        return self.angle.shape[1]


@dataclass(frozen=True)
class LogReport:
    """What became of a log's rows.

    Attributes:
        rows: rows that were read.
        episodes: episodes that were read.
        kept: transitions in the trajectories that were made of it.
        trajectories: number of these.
        jumps: places where an angle moved as its velocity says it cannot have, by (episode, row in it).
        not_finite: rows with a number that is not finite.
        short: rows that were left over, in pieces too short for a trajectory.
    """

    rows: int
    episodes: int
    kept: int
    trajectories: int
    jumps: tuple[tuple[int, int], ...]
    not_finite: int
    short: int

    def __str__(self) -> str:
        made = f"{self.trajectories:,} trajectories, {self.kept:,} transitions"
        first = f", the first at row {self.jumps[0][1]} of episode {self.jumps[0][0]}" if self.jumps else ""
        lines = [
            f"{self.rows:,} rows in {self.episodes:,} episodes: {made}",
            f"  cut at {len(self.jumps):,} jumps{first}",
            f"  dropped {self.not_finite:,} rows that are not finite, {self.short:,} rows of pieces too short",
        ]
        return "\n".join(lines)


def load_robot_log(
    path: str | os.PathLike, *, timestep: float | None = None, names: Mapping[str, str] | None = None
) -> RobotLog:
    """Read a log of joint angles, velocities and commands.

    ``.npz`` with arrays ``angle`` ``[R, J]``, ``velocity`` ``[R, J]``, ``command`` ``[R, A]`` (of one joint or command
    also ``[R]``), and possibly ``length`` ``[episodes]`` (rows of each; by default all are one episode), ``timestep``
    (seconds), and extra channels ``[R, J]`` under any other name, or ``[R, k J]``, which become ``name0``, ``name1``,
    ... with the ``k`` numbers of a joint side by side. ``.csv`` with a header: columns ``angle0``, ``angle1``, ...,
    ``velocity0``, ..., ``command0``, ..., extra channels likewise, and possibly ``episode`` (a new one where it
    changes) and ``time`` (seconds).

    Args:
        path: the file.
        timestep: time between rows, seconds, where the file does not say it.
        names: what the file calls things, by what they are called here: ``{"angle": "q", "velocity": "dq"}``; map
            an extra channel to ``""`` to leave it out.

    Raises:
        DatasetError: if the file is missing, of another kind, lacks something, or shapes do not fit.
    """
    path = Path(path)
    if not path.is_file():
        raise DatasetError(f"No robot log at {path}.")
    if path.suffix not in (".npz", ".csv"):
        raise DatasetError(f"{path}: a robot log is a .npz or .csv file.")
    try:
        arrays = _read_npz(path) if path.suffix == ".npz" else _read_csv(path)
    except (ValueError, OSError, KeyError, EOFError, BadZipFile) as error:
        raise DatasetError(f"{path} cannot be read as a robot log: {error}") from error
    for here, there in (names or {}).items():
        if there and there not in arrays:
            raise DatasetError(f"{path} has no {there!r} (for {here!r}); it has {sorted(arrays)}.")
        if there:
            arrays[here] = arrays.pop(there)
        else:
            arrays.pop(here, None)
    missing = [name for name in _NEEDED if name not in arrays]
    if missing:
        raise DatasetError(
            f"{path} lacks {missing}; it has {sorted(arrays)}. Say what they are called with names={{...}}."
        )
    step = arrays.pop("timestep", None)
    timestep = timestep if timestep is not None else None if step is None else float(np.median(step))
    if timestep is None or not 0 < timestep < np.inf:
        raise DatasetError(f"{path} does not say its time step; give timestep=SECONDS.")
    angle, velocity, command = (_columns(arrays.pop(name)).astype(np.float64) for name in _NEEDED)
    length = np.atleast_1d(arrays.pop("length", np.array([len(angle)]))).astype(np.int64)
    if angle.ndim != 2 or velocity.shape != angle.shape or command.ndim != 2 or len(command) != len(angle):
        raise DatasetError(
            f"{path}: angle {angle.shape}, velocity {velocity.shape} and command {command.shape} do not fit."
        )
    if length.sum() != len(angle) or (length < 1).any():
        raise DatasetError(f"{path}: length adds up to {length.sum()} rows, but there are {len(angle)}.")
    return RobotLog(angle, velocity, command, length, timestep, _extras(arrays, angle, path))


def _columns(values: np.ndarray) -> np.ndarray:
    return values[:, None] if values.ndim == 1 else values


def _extras(arrays: dict[str, np.ndarray], angle: np.ndarray, path: Path) -> dict[str, np.ndarray]:
    extra, (rows, joints) = {}, angle.shape
    for name, values in arrays.items():
        if values.ndim != 2 or len(values) != rows or not np.issubdtype(values.dtype, np.number):
            continue  # names of episodes and the like
        count, rest = divmod(values.shape[1], joints)
        if rest:
            raise DatasetError(
                f"{path}: {name!r} has {values.shape[1]} columns, which is no multiple of the {joints} joints;"
                f' leave it out with names={{{name!r}: ""}}.'
            )
        for index in range(count):
            key = name if count == 1 else f"{name}{index}"
            extra[key] = values[:, index::count].astype(np.float64)
    return extra


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def _read_csv(path: Path) -> dict[str, np.ndarray]:
    with path.open() as file:
        header = [name.strip() for name in file.readline().split(",")]
    table = np.atleast_2d(np.loadtxt(path, delimiter=",", skiprows=1, dtype=np.float64))
    if table.shape[1] != len(header):
        raise ValueError(f"{len(header)} names for {table.shape[1]} columns")
    columns: dict[str, list[tuple[int, int]]] = {}
    for index, name in enumerate(header):
        base, number = re.fullmatch(r"(.*?)(\d*)", name).groups()  # pyright: ignore[reportOptionalMemberAccess]
        columns.setdefault(base, []).append((int(number or 0), index))
    arrays = {base: table[:, [index for _, index in sorted(entries)]] for base, entries in columns.items()}
    if "episode" in arrays:
        episode = arrays.pop("episode")[:, 0]
        begins = np.flatnonzero(np.r_[True, episode[1:] != episode[:-1]])
        arrays["length"] = np.diff(np.r_[begins, len(episode)])
    if "time" in arrays:
        steps = np.diff(arrays.pop("time")[:, 0])
        arrays["timestep"] = steps[steps > 0]
    return arrays


def log_trajectories(
    log: RobotLog,
    steps: int,
    *,
    every: int = 1,
    lag: int = 0,
    jump: float = 50.0,
    overlap: bool = False,
    episodes: Sequence[int] | np.ndarray | None = None,
) -> tuple[TensorDict, LogReport]:
    """Trajectories of equal length from a log, none across a gap, a jump or two episodes.

    Args:
        log: the log.
        steps: transitions in each trajectory.
        every: keep every so many rows; the commands in between are averaged.
        lag: rows by which a command is delayed: paired with a state is the command of so many rows before.
        jump: a change of an angle that its velocities do not explain counts as a jump if it is so many times larger
            than such changes usually are (their 90 % quantile), and larger than what the largest logged velocity
            explains.
        overlap: let trajectories begin at every row, for training; by default each row is in one at most.
        episodes: which episodes to take; default: all.

    Returns:
        TensorDict ``[M]`` of ``state`` ``[M, steps + 1, J + 1, 3 + extras]`` and ``action`` ``[M, steps, A]``,
        float64, and ``episode`` ``[M]``, and the report of what was dropped.

    Raises:
        ValueError: if an option does not fit, or no trajectory is left.
    """
    if steps < 1 or every < 1 or lag < 0 or not jump > 0:
        raise ValueError(
            f"steps={steps}, every={every}, lag={lag}, jump={jump}: counts from 1, a lag from 0, a jump above 0."
        )
    begins = np.r_[0, np.cumsum(log.length)]
    chosen = range(len(log.length)) if episodes is None else [int(episode) for episode in episodes]
    breaks = _jumps(log, jump)
    values = np.concatenate((log.angle, log.velocity, log.command, *log.extra.values()), axis=1)
    finite: np.ndarray = np.asarray(np.isfinite(values).all(1))
    states, actions, which, jumps = [], [], [], []
    rows = dropped = used = 0
    extras = list(log.extra.values())
    for episode in chosen:
        first, last = begins[episode], begins[episode + 1]
        rows += last - first
        dropped += int((~finite[first:last]).sum())
        here = np.flatnonzero(breaks[first : last - 1])
        jumps += [(episode, int(row)) for row in here]
        # A piece ends at a row after which the arm jumps, and at rows that are not finite.
        stops = np.r_[first + here + 1, np.flatnonzero(~finite[first:last]) + first, last]
        start = first
        for stop in np.unique(stops):
            piece = slice(start, stop)
            start = stop + (stop < last and not finite[stop])
            state = chain_states(log.angle[piece], log.velocity[piece], [extra[piece] for extra in extras])
            command = log.command[piece]
            if lag:
                state, command = state[lag:], command[: len(command) - lag]
            count = (len(state) - 1) // every
            if count < steps:
                continue
            state = state[: count * every + 1 : every]
            command = command[: count * every].reshape(count, every, -1).mean(1)
            begin = np.arange(0, count - steps + 1, 1 if overlap else steps)
            window = begin[:, None] + np.arange(steps + 1)
            states.append(state[window])
            actions.append(command[window[:, :-1]])
            which.append(np.full(len(begin), episode))
            used += lag + (steps * len(begin) if not overlap else count) * every + 1
    if not states:
        raise ValueError(f"No piece of the log has {steps} transitions of {every} rows; take fewer.")
    data = {"state": np.concatenate(states), "action": np.concatenate(actions), "episode": np.concatenate(which)}
    trajectories = TensorDict(
        {key: torch.from_numpy(value) for key, value in data.items()}, batch_size=[len(data["state"])]
    )
    kept = trajectories["action"].shape[0] * steps
    report = LogReport(
        int(rows), len(chosen), kept, len(trajectories), tuple(jumps), dropped, int(rows - dropped - used)
    )
    return trajectories, report


def _jumps(log: RobotLog, jump: float) -> np.ndarray:
    """``[R - 1]`` bool: whether an angle jumps between two rows of an episode."""
    # Infinities would warn, and explain every jump.
    angle, velocity = (np.where(np.isfinite(values), values, np.nan) for values in (log.angle, log.velocity))
    change = np.diff(angle, axis=0)
    turned = (change + np.pi) % (2 * np.pi) - np.pi  # the short way round
    explained = log.timestep * (velocity[:-1] + velocity[1:]) / 2
    left = np.abs(turned - explained)
    inside = np.ones(len(left), dtype=bool)
    inside[np.cumsum(log.length)[:-1] - 1] = False
    good = inside & np.isfinite(left).all(1)
    usual = np.quantile(left[good], 0.9, axis=0) if good.any() else np.inf
    fastest = log.timestep * np.abs(velocity).max(0, where=~np.isnan(velocity), initial=0.0)
    return good & (left > np.maximum(jump * usual, fastest)).any(1)


def log_chain(
    log: RobotLog,
    name: str,
    *,
    every: int = 1,
    commands: Sequence[Sequence[int]] | None = None,
    carried_by: Sequence[int] = (),
) -> JointChain:
    """The robot of a log as a graph.

    Args:
        log: the log.
        name: name of the robot.
        every: as of :func:`log_trajectories`.
        commands: for each joint the commands that act on it; by default they are dealt out in order, as many to each.
        carried_by: for each joint the one before it, -1 for the base; by default each is carried by the last: an arm.

    Raises:
        ValueError: if commands cannot be dealt out evenly.
    """
    joints, count = log.num_joints, log.command.shape[1]
    if commands is None:
        if count % joints:
            raise ValueError(
                f"{count} commands cannot be dealt out evenly to {joints} joints; say which act on which joint."
            )
        each = count // joints
        commands = [range(joint * each, (joint + 1) * each) for joint in range(joints)]
    finite = log.command[np.isfinite(log.command).all(1)]
    return JointChain(
        name,
        tuple(f"joint{joint}" for joint in range(joints)),
        log.timestep * every,
        tuple(tuple(indices) for indices in commands),
        extras=tuple(log.extra),
        action_low=finite.min(0),
        action_high=finite.max(0),
        carried_by=tuple(carried_by),
    )
