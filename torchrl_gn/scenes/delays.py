"""Delays of actuators, and the state channels of their past controls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_gn.scenes.node_channels import NodeChannels, moved_nodes, numbered
from torchrl_gn.scenes.topology import EdgePair

_ROUNDING = 1e-6  # of a physics step


@dataclass(frozen=True, eq=False)
class Delays(NodeChannels):
    """Past controls that are still to act, before clipping, by age for each delayed actuator."""

    actuator: np.ndarray  # [K] actuator of each control
    age: np.ndarray  # [K] control steps since each was given, from 1
    lag: np.ndarray  # [A] delay of each actuator's control, physics steps; 0 without

    def read(self, model: mujoco.MjModel, substeps: int, physics: np.ndarray) -> np.ndarray:
        """Read past controls ``[*B, K]`` from MuJoCo's buffers, at ends of control steps.

        A control step has ``substeps`` physics steps.
        """
        delayed = np.empty((*physics.shape[:-1], len(self.actuator)))
        for index, (actuator, age) in enumerate(self._past_controls()):
            times, values = (physics[..., where] for where in _buffer(model, actuator))
            before = times < _end(model, substeps, physics, age)
            at = np.where(before, times, -np.inf).argmax(-1)[..., None]  # the last control of its step
            delayed[..., index] = np.take_along_axis(values, at, -1)[..., 0]
        return delayed

    def add(self, model: mujoco.MjModel, substeps: int, physics: np.ndarray, change: np.ndarray) -> None:
        """Change the past controls in physics ``[*B, S]`` by ``[*B, K]``, in place."""
        for index, (actuator, age) in enumerate(self._past_controls()):
            times, values = (physics[..., where] for where in _buffer(model, actuator))
            begin, end = (_end(model, substeps, physics, each) for each in (age + 1, age))
            values += np.where((begin <= times) & (times < end), change[..., index, None], 0.0)

    def _past_controls(self) -> list[tuple[int, int]]:
        return list(zip(self.actuator.tolist(), self.age.tolist(), strict=True))

    def hold(self, model: mujoco.MjModel, physics: np.ndarray, actuator: int, control: float) -> None:
        """Set all past controls of an actuator in physics ``[S]`` to one control, in place."""
        physics[_buffer(model, actuator)[1]] = control

    def times(self, model: mujoco.MjModel) -> np.ndarray:
        """Return the indices of times in physics, the present time first."""
        late = np.flatnonzero(self.lag).tolist()
        buffers = [np.arange(times.start, times.stop) for times, _ in (_buffer(model, each) for each in late)]
        return np.concatenate([np.zeros(1, dtype=np.int64), *buffers])


def _buffer(model: mujoco.MjModel, actuator: int) -> tuple[slice, slice]:
    """Return slices of physics ``[S]`` with the times and the values of an actuator's past controls."""
    # A buffer begins with two numbers of its own.
    first = 1 + model.nq + model.nv + model.na + int(model.actuator_historyadr[actuator]) + 2
    count = int(model.actuator_history[actuator, 0])
    return slice(first, first + count), slice(first + count, first + 2 * count)


def _end(model: mujoco.MjModel, substeps: int, physics: np.ndarray, age: int) -> np.ndarray:
    """Return the time ``[*B, 1]`` at which the control step ``age`` steps ago ended, less a margin for rounding."""
    return physics[..., :1] - ((age - 1) * substeps + 0.25) * model.opt.timestep


def find_delays(model: mujoco.MjModel, pairs: Sequence[EdgePair], action: np.ndarray, substeps: int) -> Delays:
    """Find the delays of a model; ``action`` ``[P, C]`` holds the actuators at the edge ``pairs``."""
    lag = np.zeros(model.nu, dtype=np.int64)
    if (history := getattr(model, "actuator_history", None)) is not None:  # MuJoCo before 3.5 has none
        late = history[:, 0] > 0
        lag[late] = np.ceil(model.actuator_delay[late] / model.opt.timestep)
    held = [(actuator, age) for actuator in range(model.nu) for age in range(1, -(-lag[actuator] // substeps) + 1)]
    actuator, age = (np.array([each[part] for each in held], dtype=np.int64) for part in (0, 1))
    node, slot = numbered(moved_nodes(actuator.tolist(), pairs, action))
    return Delays(node, slot, actuator, age, lag)


def round_delays(spec: mujoco.MjSpec) -> None:
    """Round delays to whole physics steps, as MuJoCo does, and drop buffers without delay.

    Delays are set half a physics step below a multiple: at a multiple, MuJoCo's lag depends on rounding of the time.
    """
    for actuator in spec.actuators:
        if not (samples := getattr(actuator, "nsample", 0)):  # MuJoCo before 3.5 has none
            continue
        late = int(np.ceil(actuator.delay / spec.option.timestep - _ROUNDING))
        if lag := min(late, samples):
            actuator.delay = (lag - 0.5) * spec.option.timestep
            actuator.nsample = 2 * lag + 1  # enough at half the physics step, too
        else:
            actuator.nsample = 0  # the buffer affects no force
