"""Robot logs from files and dataset folders."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

from torchrl_gn.data.dataset_files import DatasetError
from torchrl_gn.data.logs.log_checks import check_robot_log, cuts_episodes, likely_role, lone_jumps
from torchrl_gn.data.logs.numbers import common_timestep, episode_lengths, real_numbers, row_counts, seconds
from torchrl_gn.data.logs.robot_log import RobotLog, short_way
from torchrl_gn.data.logs.robot_log_formats import READERS, LogArrays, Names, Source, naming_unreadable, read_log_arrays


def load_robot_log(
    path: str | os.PathLike,
    *,
    timestep: float | None = None,
    names: Names | None = None,
    degrees: bool = False,
) -> RobotLog:
    """Read a log of joint angles, velocities and commands.

    An ``.npz`` file has arrays ``angle`` ``[R, J]``, ``velocity`` ``[R, J]`` and ``command`` ``[R, A]``. Optional are
    ``length`` ``[episodes]`` (rows of each) or ``episode`` ``[R]`` (a new one starts where it changes), ``time``
    ``[R]`` (seconds) or ``timestep``, and extra channels ``[R, J]`` of any other name. Extra channels ``[R, k J]``,
    with the ``k`` numbers of a joint side by side, become ``name0``, ``name1``, ... A ``.csv`` file has a header and
    columns ``angle0``, ``angle1``, ..., or others that ``names`` lists. A ``.parquet`` file has such columns, or lists;
    an ``.hdf5`` (``.h5``) file has datasets of these names.

    LeRobot dataset folders (version 2 or 3) need ``names`` only if ``observation.state`` holds more than angles. Select
    its columns by place, ``"observation.state[:7]"``, or by their names in ``info.json``, ``"observation.state.*pos"``.
    Arrays of robomimic's ``.hdf5`` files have their names within an episode, ``"obs/robot0_joint_pos"`` (the default).
    From both formats, only named arrays are read.

    Args:
        timestep: time between rows, seconds, if the file does not have it.
        names: name of each array in the file, as ``{"angle": "q", "velocity": "dq"}``. A list names an array's columns
            in the order of the joints, ``["q_hip", "q_knee"]``; a pattern matches columns in the file's order,
            ``"q_*"``; ``""`` leaves an array out. ``{"command": ""}`` means a robot without motors;
            ``{"velocity": ""}`` takes backward differences of the angles, which lose the first row of each episode and
            the first row after each gap or jump. A jump is a change of over 0.01 rad that is five times as large as the
            changes around it and as nine in ten others.
        degrees: the file has degrees and degrees/s.

    Raises:
        DatasetError: if the file is missing or incomplete, or contradicts itself or ``timestep``: several columns share
            a name, an array of another name looks like times, episodes or their ends, or a single joint's like a count
            of rows, ``length`` and ``episode`` disagree, rows are out of order, or velocities contradict the changes of
            the angles in sign or unit. Numbers that are only implausible raise a
            LogContentWarning.
        ImportError: if the format needs a package that is not installed.
    """
    path = Path(path)
    if not path.exists():
        raise DatasetError(f"No robot log at {path}.")
    if path.suffix not in READERS and not path.is_dir():
        raise DatasetError(f"{path}: a robot log is a {', '.join(READERS)} file, or a LeRobot dataset folder.")
    with naming_unreadable(path, "a robot log"):
        arrays = read_log_arrays(path)
    all_names = {**arrays.names, **(names or {})}
    try:
        log = _log(arrays, all_names, timestep, degrees=degrees)
        check_robot_log(log, degrees=degrees, measured=all_names.get("velocity") != "")
    except ValueError as error:
        raise DatasetError(f"{path} cannot be read as a robot log: {error}") from error
    return log


def _log(found: LogArrays, names: Names, timestep: float | None, *, degrees: bool) -> RobotLog:
    arrays, unread = _renamed(found, names)
    if names.get("command") == "" and "angle" in arrays:
        arrays["command"] = np.zeros((len(arrays["angle"]), 0))
    missing = {"angle", "velocity", "command"} - arrays.keys() - {name for name in names if not names[name]}
    if missing or "angle" not in arrays:
        raise ValueError(
            f"it lacks {sorted(missing)}; it has {sorted(found.arrays)}. Give their names in the file with"
            ' names={...}; for a robot without motors, names={command: ""}; without velocities, names={velocity: ""}.'
        )
    own = {name: _columns(name, arrays.pop(name)) for name in ("angle", "command", "velocity") if name in arrays}
    angle, command = own["angle"], own["command"]
    velocity = own["velocity"] if "velocity" in own else np.full(angle.shape, np.nan)
    if angle.ndim != 2 or velocity.shape != angle.shape or command.ndim != 2 or len(command) != len(angle):
        raise ValueError(f"angle {angle.shape}, velocity {velocity.shape} and command {command.shape} do not fit.")
    if not angle.size:
        raise ValueError(f"there is nothing in it: {len(angle)} rows of {angle.shape[1]} joints.")
    _check_joints(found, names, arrays)
    if degrees:  # before differences of angles are wrapped
        angle, velocity = np.deg2rad(angle), np.deg2rad(velocity)
    length, time = _length(arrays, len(angle)), _of_every_row(arrays, "time", len(angle))
    time = None if time is None else seconds(time)
    steps = {"timestep": arrays.pop("timestep")} if "timestep" in arrays else {}
    remedy = ', such as names={time: ""} or {timestep: ""}. For another time step, resample= trajectories'
    timestep = common_timestep(steps, time, length, timestep, even=False, remedy=remedy)
    extra, more = _extras(arrays, angle.shape, length, names)
    log = RobotLog(angle, velocity, command, length, timestep, extra, time, found.unread | unread | more)
    if names.get("velocity") == "":
        change, inside = short_way(np.diff(angle, axis=0)), log.inside & ~log.gaps
        inside &= ~lone_jumps(change[..., None], inside & np.isfinite(change).all(1)).any(1)
        rate = change / np.where(log.steps > 0, log.steps, np.nan)[:, None]
        velocity[1:] = np.where(inside[:, None], rate, np.nan)
    return log


def _check_joints(found: LogArrays, names: Names, others: Iterable[str]) -> None:
    """Raise ValueError if the columns of velocities or ``others`` belong to other joints than the angles.

    A column's name gives its joint, as a number or as the text that matches the ``*`` of a pattern.
    """
    joints = _joints(found, names.get("angle", "angle"))
    for name in ("velocity", *others):
        channel_joints = _joints(found, names.get(name, name))
        if len(channel_joints) == len(joints) > 1 and channel_joints != joints and {*channel_joints} & {*joints}:
            raise ValueError(
                f"columns of the angles are of joints {joints}, but those of {name!r} of {channel_joints}: some are"
                f" missing, or in another order. Name all in the same order, names={{{name!r}: [...]}}"
            )


def _joints(found: LogArrays, source: Source) -> list[str]:
    """Return the joints that the names of a source's columns give; empty if they give none."""
    if not isinstance(source, str) or source in found.arrays:
        return found.numbers.get(source, []) if isinstance(source, str) else []
    columns = [f"{array}.{label}" for array, labels in found.columns.items() for label in labels]
    before, _, after = source.partition("*")
    return [
        each[len(before) : len(each) - len(after)]
        for each in (columns if any(fnmatchcase(each, source) for each in columns) else found.arrays)
        if "*" in source and fnmatchcase(each, source)
    ]


def _renamed(found: LogArrays, names: Names) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Apply ``names``; return the arrays by name, and the reasons why other arrays are skipped."""
    arrays, picked, used = found.arrays, {}, set()
    for name, source in names.items():
        if source:
            sources, picked[name] = _picked(found, name, source)
            used |= sources
    remaining = {name: values for name, values in arrays.items() if name not in used and name not in names.values()}
    unread = {name: f"{names[name]!r} was named for it" for name in remaining if names.get(name)}
    if found.only_named:
        unread |= {name: "no name is given to it" for name in remaining if name not in ("length", "timestep", *names)}
        remaining = {name: values for name, values in remaining.items() if name not in unread}
    return {name: values for name, values in remaining.items() if name not in names} | picked, unread


def _picked(found: LogArrays, name: str, source: Source) -> tuple[set[str], np.ndarray]:
    """Return the names of the arrays that ``source`` selects from, and the selected values side by side."""
    arrays = found.arrays
    if not isinstance(source, str):
        parts = [_picked(found, name, each) for each in source]
        return set().union(*(used for used, _ in parts)), np.hstack([_columns(name, values) for _, values in parts])
    if source in arrays:
        return {source}, arrays[source]
    if (chosen := re.fullmatch(r"(.+)\[(-?\d*):(-?\d*)\]", source)) and chosen[1] in arrays:
        where = slice(*(int(bound) if bound else None for bound in chosen.groups()[1:]))
        return {chosen[1]}, np.atleast_2d(arrays[chosen[1]].T).T[:, where]
    for array, labels in found.columns.items():
        columns = [index for index, label in enumerate(labels) if fnmatchcase(f"{array}.{label}", source)]
        if columns:
            return {array}, arrays[array][:, columns]
    if matching := [array for array in arrays if "*" in source and fnmatchcase(array, source)]:
        return _picked(found, name, matching)
    if source in found.unread:
        raise ValueError(f"its {source!r} (for {name!r}) cannot be read: {found.unread[source]}.")
    labelled = "".join(f"; {array!r} has columns {labels}" for array, labels in found.columns.items())
    raise ValueError(
        f"it has no {source!r} (for {name!r}), only {sorted(arrays)}{labelled}. Columns with names of their own take a"
        " list, or a pattern such as 'q_*'."
    )


def _columns(name: str, values: np.ndarray) -> np.ndarray:
    return real_numbers(name, values[:, None] if values.ndim == 1 else values)


def _of_every_row(arrays: dict[str, np.ndarray], name: str, rows: int) -> np.ndarray | None:
    """Remove and return an array ``[R]``; None if there is none, or a single value, which is listed as skipped."""
    values = arrays.get(name)
    if values is None or not values.ndim:
        return None
    if values.shape not in ((rows,), (rows, 1)):
        raise ValueError(
            f'{name!r} {values.shape} must be one of each of the {rows} rows, or be left out, names={{{name}: ""}}.'
        )
    return arrays.pop(name).reshape(rows)


def _length(arrays: dict[str, np.ndarray], rows: int) -> np.ndarray:
    episode = _of_every_row(arrays, "episode", rows)
    by_row = np.array([rows]) if episode is None else episode_lengths(episode)
    length = row_counts(arrays.pop("length", by_row), rows)
    if episode is not None and not np.array_equal(length, by_row):
        raise ValueError(
            f"'length' states {len(length)} episodes, 'episode' {len(by_row)}, or of other rows: leave one out."
        )
    return length


def _refuse_roles(name: str, values: np.ndarray, joints: int, length: np.ndarray) -> None:
    """Raise ValueError if an array looks like times, episodes or an index of rows, or flags ends inside episodes."""
    rows = int(length.sum())
    role, leave = likely_role(name, values, rows), f'leave it out, names={{{name!r}: ""}}'
    as_channel = f"or read it as a channel, names={{{name!r}: {name!r}}}."
    if role == "count":
        if joints == 1:  # of other logs it is no channel
            raise ValueError(
                f"{name!r} grows by the same step from row to row, as a count of rows: {leave}, {as_channel}"
            )
    elif role == "end":
        if joints == 1 or cuts_episodes(values, length):
            raise ValueError(
                f"{name!r} looks like flags of episodes' ends: say where episodes begin, as episode, or length, and"
                f" {leave}, {as_channel}"
            )
    elif role:
        raise ValueError(f"{name!r} looks like its {role}: say so, names={{{role}: {name!r}}}, {leave}, {as_channel}")


def _extras(
    arrays: dict[str, np.ndarray], shape: tuple[int, int], length: np.ndarray, names: Names
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return further channels of every joint, and the reasons why other arrays are skipped."""
    extra, unread, (rows, joints) = {}, {}, shape
    for name, values in arrays.items():
        if name not in names:
            _refuse_roles(name, values, joints, length)
        if joints == 1 and values.shape == (rows,):
            values = values[:, None]
        if not np.issubdtype(values.dtype, np.number):
            unread[name] = "not numbers"
            continue
        if values.ndim != 2 or len(values) != rows:
            unread[name] = f"of shape {list(values.shape)} and not {[rows, joints]}"
            continue
        count, remainder = divmod(values.shape[1], joints)
        if remainder:
            wrong = f"{name!r} has {values.shape[1]} columns, not a multiple of the {joints} joints"
            read = "angle, velocity, command, length, episode, time or timestep"
            raise ValueError(f'{wrong}; name it {read}, or leave it out with names={{{name!r}: ""}}.')
        for index in range(count):
            channel = name if count == 1 else f"{name}{index}"
            if channel in extra:
                raise ValueError(f"two of its arrays are the channel {channel!r}: {name!r} has {count} of each joint.")
            extra[channel] = real_numbers(name, values[:, index::count])
    return extra, unread
