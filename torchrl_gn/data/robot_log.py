"""Logs of real robots: joint angles, velocities and commands, where they break, and the robot as a graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from torchrl_gn.scenes.kinematic_tree import KinematicTree

_GAP = 1.5  # times the usual step: with one row missing it is 2
_EVEN = 0.01  # of a step, by which time stamps may be rounded


@dataclass(frozen=True, eq=False)
class RobotLog:
    """Joint-space log of a robot, row after row.

    Attributes:
        angle: ``[R, J]`` joint angles, radians.
        velocity: ``[R, J]`` joint velocities, rad/s.
        command: ``[R, A]`` commands given in each row's state; ``[R, 0]`` of a robot without motors.
        length: rows of each episode; they add up to ``R``.
        timestep: time between rows, seconds; where they have time stamps the usual one.
        extra: further channels by name, ``[R, J]`` each.
        time: ``[R]`` time stamps, seconds; None: no row is missing, and all are as far apart.
        unread: what else was in the file, and why it was not read, by name.
    """

    angle: np.ndarray
    velocity: np.ndarray
    command: np.ndarray
    length: np.ndarray
    timestep: float
    extra: dict[str, np.ndarray] = field(default_factory=dict)
    time: np.ndarray | None = None
    unread: dict[str, str] = field(default_factory=dict)

    @property
    def num_joints(self) -> int:
        """Number of joints ``J``."""
        return self.angle.shape[1]

    @property
    def begins(self) -> np.ndarray:
        """``[episodes + 1]`` the row in which each episode begins, and ``R``."""
        return np.r_[0, np.cumsum(self.length)]

    @property
    def finite(self) -> np.ndarray:
        """``[R]`` bool: which rows have finite numbers alone."""
        channels = [self.angle, self.velocity, self.command, *self.extra.values()]
        channels += [] if self.time is None else [self.time[:, None]]
        return np.logical_and.reduce([np.isfinite(values).all(1) for values in channels])

    @property
    def steps(self) -> np.ndarray:
        """``[R - 1]`` seconds from each row to the next; from the end of an episode on they mean nothing."""
        return np.full(len(self.angle) - 1, self.timestep) if self.time is None else np.diff(self.time)

    @property
    def inside(self) -> np.ndarray:
        """``[R - 1]`` bool: whether the next row is of the same episode."""
        inside = np.ones(len(self.angle) - 1, dtype=bool)
        inside[self.begins[1:-1] - 1] = False
        return inside

    @property
    def gaps(self) -> np.ndarray:
        """``[R - 1]`` bool: whether rows are missing before the next row, or its time is not later."""
        steps = self.steps
        return self.inside & np.isfinite(steps) & ((steps <= 0) | (steps > _GAP * self.timestep))

    @property
    def even(self) -> bool:
        """Whether rows are as far apart everywhere, but for gaps and the rounding of time stamps."""
        off = np.abs(self.steps - self.timestep)[self.inside & ~self.gaps]
        return not (off > _EVEN * self.timestep).any()

    @property
    def at(self) -> np.ndarray:
        """``[R]`` where rows lie, in time steps from any point on."""
        return np.arange(float(len(self.angle))) if self.time is None or self.even else self.time / self.timestep

    def jumps(self, jump: float) -> np.ndarray:
        """``[R - 1]`` bool: whether an angle jumps from a row to the next one.

        Args:
            jump: as of :func:`log_trajectories`.
        """
        # Infinities would warn, and explain every jump.
        angle, velocity = (np.where(np.isfinite(values), values, np.nan) for values in (self.angle, self.velocity))
        steps = self.steps[:, None]
        left = np.abs(short_way(np.diff(angle, axis=0)) - steps * (velocity[:-1] + velocity[1:]) / 2)
        good = self.inside & ~self.gaps & np.isfinite(left).all(1)
        usual = np.quantile(left[good], 0.9, axis=0) if good.any() else np.inf
        fastest = steps * np.abs(velocity).max(0, where=~np.isnan(velocity), initial=0.0)
        return good & (left > np.maximum(jump * usual, fastest)).any(1)

    def command_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Smallest and largest ``[A]`` of each command; equal where it never varies.

        Raises:
            ValueError: if no row has finite commands.
        """
        finite = self.command[np.isfinite(self.command).all(1)]
        if not len(finite):
            raise ValueError("No row of the log has commands that are finite.")
        return finite.min(0), finite.max(0)


def short_way(change: np.ndarray) -> np.ndarray:
    """Changes of angles the short way round, radians: -pi up to pi."""
    return (change + np.pi) % (2 * np.pi) - np.pi


def log_chain(
    log: RobotLog,
    name: str,
    *,
    resample: float | None = None,
    commands: Sequence[Sequence[int]] | None = None,
    joint_parents: Sequence[int] = (),
) -> KinematicTree:
    """The robot of a log as a graph.

    Args:
        log: the log.
        name: name of the robot.
        resample: as of :func:`log_trajectories`.
        commands: for each joint the commands that act on it, none of a joint without motor; by default they are dealt
            out in order, as many to each.
        joint_parents: for each joint the one before it, -1 for the base; by default each is carried by the last: an arm.

    Raises:
        ValueError: if commands cannot be dealt out evenly, are none of the log's, or are finite in no row.
    """
    joints, count = log.num_joints, log.command.shape[1]
    if commands is None:
        if count % joints:
            raise ValueError(
                f"{count} commands cannot be dealt out evenly to {joints} joints; say which act on which joint, as"
                " commands=[[0], []] where the second of two joints has no motor."
            )
        each = count // joints
        commands = [range(joint * each, (joint + 1) * each) for joint in range(joints)]
    low, high = log.command_bounds()
    return KinematicTree(
        name,
        tuple(f"joint{joint}" for joint in range(joints)),
        log.timestep if resample is None else resample,
        tuple(tuple(indices) for indices in commands),
        extras=tuple(log.extra),
        action_low=low,
        action_high=high,
        joint_parents=tuple(joint_parents),
    )
