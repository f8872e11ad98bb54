"""Logs of joint angles, velocities and commands, their breaks, and the robot as a graph."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from torchrl_gn.data.logs.numbers import EVEN
from torchrl_gn.scenes.kinematic_tree import KinematicTree

_GAP = 1.5  # threshold of a gap, in usual steps; one missing row makes 2


@dataclass(frozen=True, eq=False, repr=False)
class RobotLog:
    """Joint-space log of a robot, ``R`` rows."""

    angle: np.ndarray  # [R, J] radians
    velocity: np.ndarray  # [R, J] rad/s
    command: np.ndarray  # [R, A] sent in each row's state; [R, 0] without motors
    length: np.ndarray  # [episodes] rows of each; their sum is R
    timestep: float  # (usual) time between rows, seconds
    extra: dict[str, np.ndarray] = field(default_factory=dict)  # further channels by name, [R, J] each
    time: np.ndarray | None = None  # [R] time stamps, seconds; None: rows are evenly spaced and none is missing
    unread: dict[str, str] = field(default_factory=dict)  # reason for each array of the file that was not read

    def __repr__(self) -> str:
        sizes = {"episodes": len(self.length), "rows": len(self.angle), "joints": self.num_joints}
        sizes |= {"commands": self.command.shape[1], "timestep": float(f"{self.timestep:.4g}")}
        sizes |= {"extra": list(self.extra)} if self.extra else {}
        return f"RobotLog({', '.join(f'{name}={value}' for name, value in sizes.items())})"

    @property
    def num_joints(self) -> int:
        """Number of joints ``J``."""
        return self.angle.shape[1]

    @property
    def begins(self) -> np.ndarray:
        """First row of each episode, then ``R``: ``[episodes + 1]``."""
        return np.r_[0, np.cumsum(self.length)]

    @property
    def finite(self) -> np.ndarray:
        """Mask ``[R]`` of rows whose numbers are all finite."""
        stamps = [] if self.time is None else [self.time[:, None]]
        channels = [self.angle, self.velocity, self.command, *self.extra.values(), *stamps]
        return np.logical_and.reduce([np.isfinite(values).all(1) for values in channels])

    @property
    def steps(self) -> np.ndarray:
        """Seconds ``[R - 1]`` from each row to the next; meaningless between episodes."""
        return np.full(len(self.angle) - 1, self.timestep) if self.time is None else np.diff(self.time)

    @property
    def inside(self) -> np.ndarray:
        """Mask ``[R - 1]`` of rows whose next row is in the same episode."""
        inside = np.ones(len(self.angle) - 1, dtype=bool)
        inside[self.begins[1:-1] - 1] = False
        return inside

    @property
    def gaps(self) -> np.ndarray:
        """Mask ``[R - 1]`` of rows after which rows are missing, or whose next row is not later."""
        steps = self.steps
        return self.inside & np.isfinite(steps) & ((steps <= 0) | (steps > _GAP * self.timestep))

    @property
    def even(self) -> bool:
        """True if rows are evenly spaced, apart from gaps and rounding."""
        off = np.abs(self.steps - self.timestep)[self.inside & ~self.gaps]
        return not (off > EVEN * self.timestep).any()

    @property
    def at(self) -> np.ndarray:
        """Times ``[R]`` of the rows in time steps, from any origin."""
        return np.arange(float(len(self.angle))) if self.time is None or self.even else self.time / self.timestep

    def jumps(self, jump: float) -> np.ndarray:
        """Detect rows ``[R - 1]`` after which an angle jumps; see :func:`log_trajectories` for ``jump``."""
        # Infinities would raise warnings, and explain every jump.
        angle, velocity = (np.where(np.isfinite(values), values, np.nan) for values in (self.angle, self.velocity))
        steps = self.steps[:, None]
        residual = np.abs(short_way(np.diff(angle, axis=0)) - steps * (velocity[:-1] + velocity[1:]) / 2)
        good = self.inside & ~self.gaps & np.isfinite(residual).all(1)
        usual = np.quantile(residual[good], 0.9, axis=0) if good.any() else np.inf
        fastest = steps * np.abs(velocity).max(0, where=~np.isnan(velocity), initial=0.0)
        return good & (residual > np.maximum(jump * usual, fastest)).any(1)

    def command_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the smallest and largest value ``[A]`` of each command; ValueError if no row has finite commands."""
        finite = self.command[np.isfinite(self.command).all(1)]
        if not len(finite):
            raise ValueError("No row of the log has finite commands.")
        return finite.min(0), finite.max(0)


def short_way(change: np.ndarray) -> np.ndarray:
    """Wrap angle changes, radians, to [-pi, pi)."""
    return (change + np.pi) % (2 * np.pi) - np.pi


def pieces(
    log: RobotLog, episodes: Sequence[int], breaks: np.ndarray, finite: np.ndarray
) -> Iterator[tuple[int, int, int]]:
    """Yield the episode, first row, and last row + 1 of each unbroken piece of one row or more."""
    begins = log.begins
    for episode in episodes:
        start, last = int(begins[episode]), int(begins[episode + 1])
        # A piece ends at a row after which the log breaks, and at rows that are not finite.
        stops = start + np.r_[np.flatnonzero(breaks[start : last - 1]) + 1, np.flatnonzero(~finite[start:last])]
        for stop in [*np.unique(stops).tolist(), last]:
            if stop > start:  # rows that are not finite leave nothing between them
                yield episode, start, stop
            start = stop + (stop < last and not finite[stop])


def unbroken(log: RobotLog, jump: float) -> list[slice]:
    """Return the rows of each piece between gaps, jumps, ends of episodes and non-finite rows."""
    breaks = log.gaps | log.jumps(jump)
    return [slice(start, stop) for _, start, stop in pieces(log, range(len(log.length)), breaks, log.finite)]


def log_tree(
    log: RobotLog,
    name: str,
    *,
    resample: float | None = None,
    commands: Sequence[Sequence[int]] | None = None,
    joint_parents: Sequence[int] = (),
    history: int = 0,
) -> KinematicTree:
    """Make the kinematic tree of a log's robot.

    Args:
        resample: time step, seconds; default: the log's.
        commands: command indices of each joint, empty without a motor; default: equally many per joint, in order.
        joint_parents: parent of each joint, -1 for the base; default: the joint before it.
        history: see :func:`log_trajectories`; past commands of a joint act on it too.
    """
    joints, count = log.num_joints, log.command.shape[1]
    if commands is None:
        if count % joints:
            wrong = f"{count} commands do not divide evenly among {joints} joints"
            raise ValueError(f"{wrong}; give those of each, such as commands=[[0], []] if only the first has a motor.")
        each = count // joints
        commands = [range(joint * each, (joint + 1) * each) for joint in range(joints)]
    low, high = (np.tile(bound, history + 1) for bound in log.command_bounds())
    commands = [[past * count + index for past in range(history + 1) for index in own] for own in commands]
    return KinematicTree(
        name,
        tuple(f"joint{joint}" for joint in range(joints)),
        log.timestep if resample is None else resample,
        tuple(tuple(indices) for indices in commands),
        extras=tuple(log.extra),
        action_low=low,
        action_high=high,
        joint_parents=tuple(joint_parents),
        history=history if count else 0,
    )
