"""Read robot logs from .npz and .csv files."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from torchrl_gn.data.dataset_files import DatasetError
from torchrl_gn.data.logs.robot_log import RobotLog

_Arrays = dict[str, np.ndarray]


def load_robot_log(
    path: str | os.PathLike, *, timestep: float | None = None, names: Mapping[str, str] | None = None
) -> RobotLog:
    """Read a log of joint angles, velocities and commands.

    ``.npz`` with arrays ``angle`` ``[R, J]``, ``velocity`` ``[R, J]``, ``command`` ``[R, A]``; optionally ``length``
    ``[episodes]`` (rows of each) or ``episode`` ``[R]`` (a new one starts where it changes), ``time`` ``[R]`` (seconds)
    or ``timestep``, and extra channels of any other name ``[R, J]``, or ``[R, k J]`` with the ``k`` numbers of a joint
    side by side, which become ``name0``, ``name1``, ... ``.csv`` has a header and columns ``angle0``, ``angle1``, ...

    Args:
        timestep: time between rows, seconds, if the file does not have it.
        names: name in the file of each array, as ``{"angle": "q", "velocity": "dq"}``; ``""`` leaves an array out, and
            ``{"command": ""}`` means a robot without motors.

    Raises:
        DatasetError: if the file is missing, incomplete, or contradicts itself or ``timestep``.
    """
    path = Path(path)
    if not path.is_file():
        raise DatasetError(f"No robot log at {path}.")
    if path.suffix not in (".npz", ".csv"):
        raise DatasetError(f"{path}: a robot log is a .npz or .csv file.")
    try:
        arrays = dict(np.load(path, allow_pickle=False)) if path.suffix == ".npz" else _read_csv(path)
        return _log(arrays, dict(names or {}), timestep)
    except (ValueError, OSError, KeyError, EOFError, BadZipFile) as error:
        raise DatasetError(f"{path} cannot be read as a robot log: {error}") from error


def _read_csv(path: Path) -> _Arrays:
    with path.open() as file:
        header = [name.strip() for name in file.readline().split(",")]
    table = np.atleast_2d(np.loadtxt(path, delimiter=",", skiprows=1, dtype=np.float64))
    if table.shape[1] != len(header):
        raise ValueError(f"{len(header)} names for {table.shape[1]} columns")
    columns: dict[str, list[tuple[int, int]]] = {}
    for index, name in enumerate(header):
        base, number = re.fullmatch(r"(.*?)(\d*)", name).groups()  # pyright: ignore[reportOptionalMemberAccess]
        columns.setdefault(base, []).append((int(number or 0), index))
    return {base: table[:, [index for _, index in sorted(entries)]] for base, entries in columns.items()}


def _log(arrays: _Arrays, names: dict[str, str], timestep: float | None) -> RobotLog:
    arrays, unread = _renamed(arrays, names)
    if "command" in names and not names["command"] and "angle" in arrays:
        arrays["command"] = np.zeros((len(arrays["angle"]), 0))
    if missing := [name for name in ("angle", "velocity", "command") if name not in arrays]:
        raise ValueError(
            f"it lacks {missing}; it has {sorted(arrays)}. Give their names in the file with names={{...}}; for a robot"
            ' without motors, names={command: ""}.'
        )
    angle, velocity, command = (_columns(arrays.pop(name)) for name in ("angle", "velocity", "command"))
    if angle.ndim != 2 or velocity.shape != angle.shape or command.ndim != 2 or len(command) != len(angle):
        raise ValueError(f"angle {angle.shape}, velocity {velocity.shape} and command {command.shape} do not fit.")
    length, time = _length(arrays, len(angle)), _of_every_row(arrays, "time", len(angle), number=True)
    timestep = _timestep(arrays.pop("timestep", None), time, length, timestep)
    extra, more = _extras(arrays, angle.shape)
    return RobotLog(angle, velocity, command, length, timestep, extra, time, unread | more)


def _renamed(arrays: _Arrays, names: dict[str, str]) -> tuple[_Arrays, dict[str, str]]:
    """Apply ``names``, and return why arrays that lost their name are not read."""
    for name, source in names.items():
        if source and source not in arrays:
            raise ValueError(f"it has no {source!r} (for {name!r}), only {sorted(arrays)}.")
    renamed = {name: arrays[source] for name, source in names.items() if source}
    rest = {name: values for name, values in arrays.items() if name not in names.values()}
    unread = {name: f"{names[name]!r} was named for it" for name in rest if names.get(name)}
    return {name: values for name, values in rest.items() if name not in names} | renamed, unread


def _columns(values: np.ndarray) -> np.ndarray:
    return (values[:, None] if values.ndim == 1 else values).astype(np.float64)


def _of_every_row(arrays: _Arrays, name: str, rows: int, *, number: bool) -> np.ndarray | None:
    """Remove and return an array ``[R]``; leave anything else, to be listed as not read."""
    values = arrays.get(name, np.zeros(0))
    if values.shape not in ((rows,), (rows, 1)) or (number and not np.issubdtype(values.dtype, np.number)):
        return None
    values = arrays.pop(name).reshape(rows)
    return values.astype(np.float64) if number else values


def _length(arrays: _Arrays, rows: int) -> np.ndarray:
    episode = _of_every_row(arrays, "episode", rows, number=False)
    begins = [0] if episode is None else np.flatnonzero(np.r_[True, episode[1:] != episode[:-1]])
    length = np.atleast_1d(arrays.pop("length", np.diff(np.r_[begins, rows]))).astype(np.int64)
    if length.sum() != rows or (length < 1).any():
        raise ValueError(f"length adds up to {length.sum()} rows, but there are {rows}.")
    return length


def _timestep(own: np.ndarray | None, time: np.ndarray | None, length: np.ndarray, given: float | None) -> float:
    """Return the seconds between rows, on which file, time stamps and caller must agree."""
    steps = np.zeros(0)
    if time is not None:
        steps = np.delete(np.diff(time), np.cumsum(length)[:-1] - 1)  # within episodes
        steps = steps[steps > 0]
    said = {
        "timestep=": given,
        "its timestep": None if own is None else float(np.median(own)),
        "its time stamps": float(np.median(steps)) if len(steps) else None,
    }
    said = {who: step for who, step in said.items() if step is not None}
    if not said or not all(0 < step < np.inf for step in said.values()):
        raise ValueError("it does not say its time step; give timestep=SECONDS.")
    if max(said.values()) > 1.01 * min(said.values()):
        raise ValueError(
            f"seconds between rows are {' but '.join(f'{step:g} ({who})' for who, step in said.items())}; leave out "
            'what is wrong, as names={time: ""} or {timestep: ""}. To change the time step, resample= trajectories.'
        )
    return next(iter(said.values()))


def _extras(arrays: _Arrays, shape: tuple[int, int]) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return further channels of every joint, and why other arrays are not read."""
    extra, unread, (rows, joints) = {}, {}, shape
    for name, values in arrays.items():
        if joints == 1 and values.shape == (rows,):
            values = values[:, None]
        if not np.issubdtype(values.dtype, np.number):
            unread[name] = "not numbers"
            continue
        if values.ndim != 2 or len(values) != rows:
            unread[name] = f"of shape {list(values.shape)} and not {[rows, joints]}"
            continue
        count, rest = divmod(values.shape[1], joints)
        if rest:
            wrong = f"{name!r} has {values.shape[1]} columns, not a multiple of the {joints} joints"
            raise ValueError(f'{wrong}; leave it out with names={{{name!r}: ""}}.')
        for index in range(count):
            extra[name if count == 1 else f"{name}{index}"] = values[:, index::count].astype(np.float64)
    return extra, unread
