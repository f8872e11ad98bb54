"""Logs of body poses, as motion capture writes them, and checks of their quaternion order and velocity frame."""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch

from torchrl_gn.data.dataset_files import DatasetError
from torchrl_gn.data.logs.log_checks import (
    LEAST_JUMP,
    LogContentWarning,
    check_timestep,
    check_velocities,
    cuts_episodes,
    gain_and_correlation,
    likely_role,
    lone_jumps,
)
from torchrl_gn.data.logs.numbers import common_timestep, episode_lengths, real_numbers, row_counts, seconds
from torchrl_gn.data.logs.robot_log_formats import naming_unreadable, read_npz
from torchrl_gn.maths import quaternion

Order = Literal["wxyz", "xyzw"]
Frame = Literal["world", "body"]

_NORM = 0.01  # tolerance for the length of rounded quaternions
_OTHER = 3.0  # factor by which another order or frame must fit angular velocities better
_FEWEST = 20  # fewest rows for a check of velocities
_STILL = 1e-3  # rad/s or m/s below which velocities show neither order nor frame
_JUMP = 50.0  # jumps: factor on the usual part that velocities do not explain

_READ = (
    "position",
    "quaternion",
    "velocity",
    "angular_velocity",
    "state",
    "action",
    "length",
    "episode",
    "timestep",
    "dt",
    "time",
)
_ALIKE = 0.75  # likeness of a name to one that is read: "velocities", "Actions"
_OTHER_NAMES = {"linear_velocity": "velocity"}  # more like "angular_velocity" by its letters


@dataclass(frozen=True, eq=False, repr=False)
class PoseLog:
    """Poses and velocities of bodies, ``R`` rows of ``B`` bodies, episode after episode."""

    state: np.ndarray  # [R, B, 13] position, quaternion w-first, linear and angular velocity; SI, world frame
    length: np.ndarray  # [episodes] rows of each; their sum is R
    timestep: float  # between rows, seconds
    action: np.ndarray  # [R, A] applied in each row's state; [R, 0] if nothing drives the bodies

    def __repr__(self) -> str:
        sizes = {"episodes": len(self.length), "rows": len(self.state), "bodies": self.state.shape[1]}
        sizes |= {"actions": self.action.shape[1], "timestep": float(f"{self.timestep:.4g}")}
        return f"PoseLog({', '.join(f'{name}={value}' for name, value in sizes.items())})"


def load_pose_log(
    path: str | os.PathLike, *, timestep: float | None = None, order: Order = "wxyz", frame: Frame = "world"
) -> PoseLog:
    """Read a log of body poses.

    The ``.npz`` file has ``position`` (m), ``quaternion`` and optionally ``velocity`` (m/s, world frame) and
    ``angular_velocity`` (rad/s); or it has ``state``, all four side by side. Arrays are ``[R, B, k]``, or ``[R, k]``
    for one body, with ``length`` ``[episodes]`` (rows of each) or ``episode`` ``[R]`` (a new one starts where it
    changes); default: one episode. Padded arrays are ``[episodes, T, B, k]``, with ``length``. Optional are ``action``
    ``[R, A]``, padded likewise, and ``timestep``, ``dt`` or ``time`` ``[R]`` (seconds).

    Missing velocities are computed by backward differences, which lose the first row of each episode.

    Args:
        timestep: time between rows, seconds, if the file does not have it.
        order: order of quaternions: w first (MuJoCo) or last (ROS, SciPy).
        frame: frame of angular velocities: the world's or the body's (MuJoCo's free joints, gyroscopes).

    Raises:
        DatasetError: if the file is missing or incomplete, numbers are not finite, quaternions have no unit length,
            time stamps are uneven, angular velocities contradict ``order`` or ``frame``, velocities contradict the
            changes of poses in sign, unit or frame, a pose jumps within an episode, flags (``done``) end episodes
            elsewhere than ``length`` or ``episode``, or the name of an array is not quite right (``actions``, ``t``).
            Numbers that are only implausible raise a LogContentWarning.
    """
    path = Path(path)
    if order not in get_args(Order) or frame not in get_args(Frame):
        raise ValueError(f"order={order!r} must be one of {get_args(Order)}, frame={frame!r} one of {get_args(Frame)}.")
    if not path.exists() or path.suffix != ".npz":
        raise DatasetError(f"No log of poses at {path}: it must be an .npz file.")
    with naming_unreadable(path, "a log of poses"):
        arrays = read_npz(path)
    try:
        return _log(arrays, timestep, order, frame)
    except ValueError as error:
        raise DatasetError(f"{path} cannot be read as a log of poses: {error}") from error


def _log(arrays: dict[str, np.ndarray], timestep: float | None, order: Order, frame: Frame) -> PoseLog:
    rows, length = _rows(arrays)
    missing = {"position", "quaternion"} - rows.keys()
    if missing:
        raise ValueError(f"it lacks {sorted(missing)}, or state; it has {sorted(arrays)}.")
    _refuse_other_names(arrays, length)
    own = {name: arrays[name] for name in ("timestep", "dt") if name in arrays}
    timestep = common_timestep(own, rows.get("time"), length, timestep, even=True)
    begins = np.cumsum(length) - length
    for name, values in rows.items():
        bad = ~np.isfinite(values).reshape(len(values), -1).all(1)
        if bad.any():
            where = _row_label(int(bad.argmax()), begins)
            raise ValueError(f"{name} is not finite at {where}; end the episode there by length, or leave it out.")
    norm = np.linalg.norm(rows["quaternion"], axis=-1)
    if (off := np.abs(norm - 1).max(1)).max() > _NORM:
        row = int(off.argmax())
        raise ValueError(
            f"quaternions must have unit length, at {_row_label(row, begins)} it is {norm[row].max():.3g}: are its"
            " columns a position, a quaternion, a velocity and an angular velocity?"
        )
    turns = rows["quaternion"] / norm[..., None]
    inside = np.ones(len(turns), dtype=bool)
    inside[begins] = False
    if "angular_velocity" in rows:
        _check_reading(turns, rows["angular_velocity"], inside, timestep, order, frame)
    first = _w_first(turns, order)
    position, keep_row = rows["position"], np.ones(len(turns), dtype=bool)
    velocity, spin = rows.get("velocity"), rows.get("angular_velocity")
    check_timestep(timestep)
    bodies = [f"body {body}" for body in range(position.shape[1])]
    if velocity is not None:
        _check_frame(position, velocity, first, inside, timestep)
        moved = np.diff(position, axis=0)
        _check_velocity(moved, velocity, inside, timestep, bodies)
        _check_jumps(moved, velocity, inside, timestep, begins, "position")
    if velocity is None or spin is None:
        keep_row, length = inside, length - 1
    if velocity is None:
        _check_lone_jumps(np.diff(position, axis=0), inside, begins, "position")
        velocity = np.diff(position, axis=0, prepend=position[:1]) / timestep
    if spin is None:
        spin = np.concatenate((np.zeros_like(position[:1]), _spins(first, timestep, "world")))
        _check_lone_jumps(timestep * spin[1:], inside, begins, "rotation")
    else:
        spin = quaternion.rotate(first, torch.from_numpy(spin)).numpy() if frame == "body" else spin
        turned = timestep * _spins(first, timestep, "world")
        _check_velocity(turned, spin, inside, timestep, [f"the rotation of {body}" for body in bodies])
        _check_jumps(turned, spin, inside, timestep, begins, "rotation")
    if (length < 2).any():
        raise ValueError(f"episode {int(np.argmin(length))} has too few rows for a step.")
    state = np.concatenate((position, first.numpy(), velocity, spin), -1)
    action = rows.get("action", np.zeros((len(state), 0)))
    return PoseLog(state[keep_row], length, timestep, action[keep_row].reshape(keep_row.sum(), -1))


def _rows(arrays: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return arrays ``[R, B, k]`` (time ``[R]``, action ``[R, A]``) without padding, and the rows of each episode."""
    sizes = {"position": 3, "quaternion": 4, "velocity": 3, "angular_velocity": 3}
    entries = {name: arrays[name] for name in (*sizes, "state", "action", "time") if name in arrays}
    if single := [name for name, values in entries.items() if not values.ndim]:
        raise ValueError(f"{single} are single numbers, not a row for each time.")
    if "state" in entries:
        state = entries.pop("state")
        if state.shape[-1] != 13 or entries.keys() & sizes.keys():
            raise ValueError(f"state {state.shape} must be [..., 13], and the only array of poses.")
        entries |= dict(zip(sizes, np.split(state, (3, 7, 10), -1), strict=True))
    if "position" not in entries:
        return entries, np.zeros(0, dtype=np.int64)
    length, head = arrays.get("length"), entries["position"].shape[:2]
    if "episode" in arrays:
        if length is not None or arrays["episode"].shape not in (head[:1], (*head[:1], 1)):
            shape = arrays["episode"].shape
            raise ValueError(f"episode {shape} must be one of each of {head[0]} rows, without length.")
        length = episode_lengths(arrays["episode"].reshape(-1))
    # Arrays are padded if they have one length per episode, none longer than the padding.
    lengths = row_counts(np.array(head[0] if length is None else length), None)
    padded = "length" in arrays and entries["position"].ndim > 2 and lengths.shape == head[:1]
    padded = padded and bool(lengths.max() <= head[1]) and int(lengths.sum()) != head[0]
    if not padded and lengths.sum() != len(entries["position"]):
        raise ValueError(f"length adds up to {lengths.sum()} rows, but there are {len(entries['position'])}.")
    rows = {}
    for name, values in entries.items():
        if len(values) != head[0] or (padded and values.shape[:2] != head):
            raise ValueError(f"{name} {values.shape} does not fit position {entries['position'].shape}.")
        flat = np.concatenate([values[i, :n] for i, n in enumerate(lengths)]) if padded else values
        flat = real_numbers(name, flat) if name != "time" else flat
        if name == "time":
            flat = flat.reshape(len(flat), -1)
            if flat.shape[1] != 1:
                raise ValueError(f"time {values.shape} must be one number for each row.")
            flat = seconds(flat[:, 0])
        if name in sizes:
            flat = flat[:, None] if flat.ndim == 2 else flat
            if flat.ndim != 3 or flat.shape[2] != sizes[name]:
                raise ValueError(f"{name} {values.shape} must end with {sizes[name]} numbers of each body.")
        rows[name] = flat
    if not rows["position"].size:
        raise ValueError(f"there is nothing in it: {len(rows['position'])} rows of {rows['position'].shape[1]} bodies.")
    if (bodies := rows["position"].shape[1]) > len(rows["position"]):
        warnings.warn(
            f"The log has {bodies} bodies in {len(rows['position'])} rows: padded arrays need length.",
            LogContentWarning,
            stacklevel=2,
        )
    if len({rows[name].shape[1] for name in sizes if name in rows}) > 1:
        raise ValueError(
            f"arrays have different numbers of bodies: { {n: rows[n].shape for n in sizes if n in rows} }."
        )
    return rows, lengths


def _check_reading(
    turns: np.ndarray, spin: np.ndarray, inside: np.ndarray, timestep: float, order: Order, frame: Frame
) -> None:
    """Raise ValueError if angular velocities fit differences of the rotations far better in another order or frame.

    Also raise ValueError if they fit the inverse rotations, from the world's frame to the body's, far better.
    """
    middle = ((spin[1:] + spin[:-1]) / 2)[inside[1:]]
    if np.abs(middle).max(initial=0) < _STILL:
        return
    off, inverse = {}, {}
    for other in get_args(Order):
        for where in get_args(Frame):
            velocities = _spins(_w_first(turns, other), timestep, where)[inside[1:]]
            off[other, where] = float(np.median(np.linalg.norm(velocities - middle, axis=-1)))
            velocities = _spins(quaternion.conjugate(_w_first(turns, other)), timestep, where)[inside[1:]]
            inverse[other, where] = float(np.median(np.linalg.norm(velocities - middle, axis=-1)))
    best = min(off, key=off.__getitem__)
    if off[best] > _OTHER * min(inverse.values()) and off[best] > _STILL:
        raise ValueError(
            f"angular velocities are {off[best]:.2g} rad/s off the rotations' differences, but"
            f" {min(inverse.values()):.2g} off those of the inverse rotations: conjugate the quaternions, or"
            " turn the sign of the angular velocities"
        )
    if off[order, frame] > _OTHER * off[best] and off[order, frame] > _STILL:
        raise ValueError(
            f"angular velocities are {off[order, frame]:.2g} rad/s off the rotations' differences as order={order!r},"
            f" frame={frame!r}, but {off[best]:.2g} as order={best[0]!r}, frame={best[1]!r}: give these."
        )


def _check_frame(
    position: np.ndarray, velocity: np.ndarray, turns: torch.Tensor, inside: np.ndarray, timestep: float
) -> None:
    """Raise ValueError if linear velocities fit differences of the positions far better in the bodies' frames."""
    if inside.sum() < _FEWEST:
        return
    change = np.diff(position, axis=0)[inside[1:]] / timestep
    readings = velocity, quaternion.rotate(turns, torch.from_numpy(velocity)).numpy()
    world, body = (
        float(np.median(np.linalg.norm(((each[1:] + each[:-1]) / 2)[inside[1:]] - change, axis=-1)))
        for each in readings
    )
    if world > max(_OTHER * body, _STILL):
        raise ValueError(
            f"velocities are {world:.2g} m/s off the positions' differences, but {body:.2g} if they are in the bodies'"
            " frames: rotate them to the world's"
        )


def _check_velocity(
    change: np.ndarray, velocity: np.ndarray, inside: np.ndarray, timestep: float, what: list[str]
) -> None:
    """Check velocities ``[R, B, 3]`` against the changes ``[R - 1, B, 3]`` from row to row, body by body."""
    within = inside[1:]
    if within.sum() < _FEWEST:
        return
    mean = ((velocity[1:] + velocity[:-1]) / 2)[within] * timestep
    both = (np.moveaxis(each, 1, -1).reshape(-1, len(what)) for each in (change[within], mean))  # [rows * 3, B]
    check_velocities(*gain_and_correlation(*both), what)


def _check_jumps(
    change: np.ndarray, velocity: np.ndarray, inside: np.ndarray, timestep: float, begins: np.ndarray, what: str
) -> None:
    """Raise ValueError if a body jumps within an episode, as at a reset, so that velocities do not explain it."""
    within = inside[1:, None]
    if within.sum() < _FEWEST:
        return
    off = np.linalg.norm(change - (velocity[1:] + velocity[:-1]) / 2 * timestep, axis=-1)  # [R - 1, B]
    usual = np.quantile(off[within[:, 0]], 0.9, axis=0)
    fastest = timestep * np.linalg.norm(velocity, axis=-1).max(0)
    jumps = within & (off > np.maximum(np.maximum(_JUMP * usual, fastest), LEAST_JUMP))
    if jumps.any():
        row, body = (int(index) for index in np.argwhere(jumps)[0])
        raise ValueError(
            f"the {what} of body {body} jumps after {_row_label(row, begins)}, which velocities do not explain: end the"
            " episode there by length"
        )


def _check_lone_jumps(change: np.ndarray, inside: np.ndarray, begins: np.ndarray, what: str) -> None:
    """Raise ValueError if a body jumps within an episode, by the changes ``[R - 1, B, 3]`` alone."""
    jumps = lone_jumps(change, inside[1:])
    if jumps.any():
        row, body = (int(index) for index in np.argwhere(jumps)[0])
        size = f"{np.linalg.norm(change[row, body]):.2g} {'m' if what == 'position' else 'rad'}"
        raise ValueError(
            f"the {what} of body {body} jumps after {_row_label(row, begins)}, by {size}, over five times as far as"
            " in the steps around: end the episode there by length, or give velocities"
        )


def _refuse_other_names(arrays: dict[str, np.ndarray], length: np.ndarray) -> None:
    """Raise ValueError if an array would not be read because its name is not quite right, or flags other ends."""
    for name, values in arrays.items():
        if name in _READ or not values.ndim:
            continue
        rows = len(arrays["position" if "position" in arrays else "state"])
        role = likely_role(name, values, rows)
        if role == "end" and rows == length.sum() and cuts_episodes(values, length):
            raise ValueError(f"{name!r} looks like flags of episodes' ends: give length or episode, and remove it")
        if role in (None, "end", "count") and len(values) == rows:
            close = get_close_matches(name.lower(), _READ, 1, _ALIKE)
            role = _OTHER_NAMES.get(name.lower(), next(iter(close), None))
        if role in _READ and role not in arrays:
            raise ValueError(f"{name!r} looks like its {role}, but is not read: name it {role!r}, or remove it")


def _w_first(turns: np.ndarray, order: Order) -> torch.Tensor:
    return torch.from_numpy(turns if order == "wxyz" else np.roll(turns, 1, axis=-1))


def _spins(turns: torch.Tensor, timestep: float, frame: Frame) -> np.ndarray:
    """Compute angular velocities ``[R - 1, B, 3]`` between rows by finite differences."""
    back = quaternion.conjugate(turns[:-1])
    change = quaternion.product(turns[1:], back) if frame == "world" else quaternion.product(back, turns[1:])
    return quaternion.log(change).numpy() / timestep


def _row_label(row: int, begins: np.ndarray) -> str:
    episode = int(np.searchsorted(begins, row, side="right")) - 1
    return f"row {row - begins[episode]} of episode {episode}"
