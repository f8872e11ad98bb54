"""Measurements of a log before training: rate, delay, noise, quantisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchrl_gn.data.logs.log_noise import channel_noise, half_widths
from torchrl_gn.data.logs.robot_log import RobotLog, short_way, unbroken

_PAST = 4  # rows before a command that predict it, to find its unpredicted part
_ROWS = 50_000  # largest number of commands to estimate delays from
_SIGNIFICANT = 4.0  # threshold on correlations, in standard deviations by chance
_ONSET = 0.1  # share of the largest correlation that counts as the onset of a command's effect


@dataclass(frozen=True)
class JointDelay:
    """Delay from a command to a joint's motion, in rows of the log."""

    command: int  # index of the command that the joint's acceleration follows most
    onset: int  # rows until the acceleration reacts
    peak: int  # rows until the reaction is largest
    correlation: float  # at the peak, of the command's unpredicted part with the acceleration


@dataclass(frozen=True)
class LogInspection:
    """Measured properties of a log; arrays are ``[J]``."""

    timestep: float  # seconds between rows
    jitter: float | None  # standard deviation of the time between rows, in timesteps; None without time stamps
    missing: int | None  # rows missing in the gaps of the time stamps; None without time stamps
    lag: int  # rows until commands act, from all joints together; the ``lag`` of log_trajectories
    delays: tuple[JointDelay | None, ...]  # by joint; None if no command moves it measurably
    noise: dict[str, np.ndarray]  # standard deviation by channel: angle (rad), velocity (rad/s), extras
    quantum: dict[str, np.ndarray]  # quantisation step by channel, 0 if none is found
    half_widths: dict[str, int]  # best number of rows to each side for smoothing, by channel; 0: no smoothing
    velocity_gain: np.ndarray  # slope of logged velocities over differentiated angles; 1 if units fit
    velocity_error: np.ndarray  # rad/s, root mean square of their difference
    velocity_kind: str  # differences of angles that velocities match best: backward, central or forward

    def __str__(self) -> str:
        rate = f"{1 / self.timestep:.4g} Hz, a row every {1e3 * self.timestep:.4g} ms"
        if self.jitter is None:
            rate += ", no time stamps"
        else:
            rate += f", jitter {100 * self.jitter:.2g} %, {self.missing:,} rows missing"
        kind = f"velocities are most like {self.velocity_kind} differences of the angles"
        head = ["joint", "delay (rows)", "delay (ms)", "peak (rows)", "by command"]
        head += ["angle noise", "step", "velocity noise", "step", "gain", "off by"]
        table = [head]
        for joint, delay in enumerate(self.delays):
            step = 1e3 * self.timestep
            late = ["-"] * 4
            if delay:
                late = [f"{delay.onset}", f"{delay.onset * step:.3g}", f"{delay.peak}", f"{delay.command}"]
            numbers = [values[name][joint] for name in ("angle", "velocity") for values in (self.noise, self.quantum)]
            numbers += [self.velocity_gain[joint], self.velocity_error[joint]]
            table.append([str(joint), *late, *(f"{number:.2g}" for number in numbers)])
        widths = [max(len(row[column]) for row in table) for column in range(len(head))]
        lines = ["  " + "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in table]
        others = [f"{name} {noise.mean():.2g}" for name, noise in list(self.noise.items())[2:]]
        more = [f"  noise of further channels: {', '.join(others)}"] if others else []
        return "\n".join([rate, *lines, *more, f"  {kind}"])


def inspect_log(log: RobotLog, *, jump: float = 50.0) -> LogInspection:
    """Measure a log's rate, the delay of its commands, noise, and quantisation.

    Args:
        jump: threshold of a jump, see :func:`log_trajectories`; nothing is measured across jumps.
    """
    pieces = unbroken(log, jump)
    good = log.inside & ~log.gaps & np.isfinite(log.steps)
    steps, missing = log.steps[good], log.steps[log.gaps]
    noise = channel_noise(log, pieces)
    gain, error, kind = _velocities(log, pieces)
    lag, delays = _delays(log, pieces)
    channels = {"angle": log.angle, "velocity": log.velocity, **log.extra}
    return LogInspection(
        timestep=log.timestep,
        jitter=None if log.time is None else float(steps.std() / log.timestep),
        missing=None if log.time is None else int(np.maximum(np.round(missing / log.timestep) - 1, 0).sum()),
        lag=lag,
        delays=delays,
        noise=noise,
        quantum={name: np.array([_quantum(column) for column in values.T]) for name, values in channels.items()},
        half_widths=half_widths(log, pieces, noise),
        velocity_gain=gain,
        velocity_error=error,
        velocity_kind=kind,
    )


def _delays(log: RobotLog, pieces: list[slice]) -> tuple[int, tuple[JointDelay | None, ...]]:
    """Correlate the unpredicted part of each command with the accelerations of later rows; return lag and delays.

    A command that a controller computes from states correlates with accelerations before it acts. Its part that past
    states and commands do not predict has no such correlation.
    """
    farthest = int(np.clip(0.25 / log.timestep, 10, 50))
    begin = np.concatenate([np.arange(piece.start, piece.stop - _PAST - farthest - 2) for piece in pieces] or [[]])
    rows = begin[:: 1 + len(begin) // _ROWS].astype(int) + _PAST  # rows of the commands
    if not log.command.shape[1] or len(rows) < 50:
        return 0, (None,) * log.num_joints
    state = np.hstack((np.cos(log.angle), np.sin(log.angle), log.velocity))
    past = [state[rows - shift] for shift in range(_PAST)] + [log.command[rows - shift] for shift in range(1, _PAST)]
    predictors = np.hstack((np.ones((len(rows), 1)), *past))
    new = log.command[rows] - predictors @ np.linalg.lstsq(predictors, log.command[rows], rcond=None)[0]
    rounding = 1e-9 * np.abs(log.command[rows]).max(0) + 1e-6 * log.command[rows].std(0)
    new = np.where(new.std(0) > rounding, new, 0) / np.maximum(new.std(0), 1e-30)
    correlation = np.empty((farthest + 1, log.command.shape[1], log.num_joints))
    for shift in range(farthest + 1):
        change = log.velocity[rows + shift + 1] - log.velocity[rows + shift]
        correlation[shift] = new.T @ (change - change.mean(0)) / (len(rows) * np.maximum(change.std(0), 1e-30))
    delays: list[JointDelay | None] = []
    responses = []  # [shifts], in standard deviations by chance, positive at the peak
    for joint in range(log.num_joints):
        curve = correlation[..., joint]
        peak, command = (int(index) for index in np.unravel_index(np.abs(curve).argmax(), curve.shape))
        responses.append(curve[:, command] * np.sign(curve[peak, command]) * np.sqrt(len(rows)))
        onset = _onset(np.abs(responses[-1]))
        most = float(curve[peak, command])
        delays.append(None if onset is None else JointDelay(command, onset, peak, most))
    # Joints that react alike together show a response too weak to see in one: weight each by its largest response.
    weight = np.max(responses, 1)
    together = np.abs(weight @ np.array(responses)) / max(np.linalg.norm(weight), 1e-30)
    return (_onset(together) or 0) if any(delays) else 0, tuple(delays)


def _onset(response: np.ndarray) -> int | None:
    """Return the first shift with a significant response (``[shifts]``, in standard deviations by chance), or None."""
    if response.max() < _SIGNIFICANT:
        return None
    return int(np.flatnonzero(response >= max(_ONSET * response.max(), _SIGNIFICANT))[0])


def _velocities(log: RobotLog, pieces: list[slice]) -> tuple[np.ndarray, np.ndarray, str]:
    """Find the difference of angles that velocities match best; return slope ``[J]``, error ``[J]`` and kind."""
    rows = np.concatenate([np.arange(piece.start + 1, piece.stop - 1) for piece in pieces] or [[]]).astype(int)
    if not len(rows):
        return np.full(log.num_joints, np.nan), np.full(log.num_joints, np.nan), "unknown"
    speed = short_way(np.diff(log.angle, axis=0)) / np.where(log.steps > 0, log.steps, np.nan)[:, None]
    backward, forward, logged = speed[rows - 1], speed[rows], log.velocity[rows]
    best = None
    for kind, other in (("backward", backward), ("central", (backward + forward) / 2), ("forward", forward)):
        gain = (other * logged).sum(0) / np.maximum(np.square(other).sum(0), 1e-30)
        error = np.sqrt(np.square(logged - gain * other).mean(0))
        total = float((error / np.maximum(logged.std(0), 1e-30)).sum())
        if best is None or total < best[0]:
            best = total, gain, np.sqrt(np.square(logged - other).mean(0)), kind
    assert best is not None
    return best[1:]


def _quantum(values: np.ndarray) -> float:
    """Find the quantisation step of values; 0 if there is none."""
    levels = np.unique(values[np.isfinite(values)])
    if len(levels) < 3:
        return 0.0
    gaps = np.diff(levels)
    gaps = gaps[gaps > 1e-5 * (levels[-1] - levels[0])]  # not rounding errors
    step = float(np.quantile(gaps, 0.1)) if len(gaps) else 0.0
    whole = np.abs(gaps / step - np.round(gaps / step)) < 0.1 if step else np.zeros(1)
    return step if whole.mean() > 0.9 else 0.0
