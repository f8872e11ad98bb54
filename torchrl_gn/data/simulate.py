"""Batched simulation of the true physics, on MuJoCo's own threads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
import torch
from mujoco.rollout import Rollout
from tensordict import TensorDict
from torch import Tensor

from torchrl_gn.checks import check_counts
from torchrl_gn.finite import require_finite
from torchrl_gn.processor import usable_cores
from torchrl_gn.scenes.articulation import Articulation, require_bodies
from torchrl_gn.scenes.messages import quiet_mujoco
from torchrl_gn.scenes.scene import Scene

_PHYSICS = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
_HUGE = float(mujoco.mjMAXVAL)  # MuJoCo resets a simulation with larger numbers


class UnstableSimulationError(RuntimeError):
    """Too many simulations of a scene become unstable."""


def steadier_physics(model: mujoco.MjModel) -> str:
    """Return advice to stabilise a model's simulation: the end of a sentence that begins with "use"."""
    smaller = "a smaller physics step in the model"
    if model.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER:
        return smaller
    # Euler's method integrates the velocity gains of servos explicitly.
    return f'<option integrator="implicitfast"/> (stiff servos need it) or {smaller}'


class Simulator:
    """Simulator of scenes for any batch, in float64, with actions held over each control step.

    The next state depends on (physics, action) alone, bit for bit, not on the batch or the threads. MuJoCo clamps
    actions to their bounds. A simulation is unstable if MuJoCo warns (values not finite or above 1e10, or a full
    contact buffer), including the step after the last; its later states are meaningless. MuJoCo's own messages are
    suppressed.

    Args:
        scenes: the scene, or several of equal topology (variants of one system).
        num_threads: threads of the simulation; default: the cores this process may use.
        memory: bytes of MuJoCo's output held at a time; default: 8 MB per thread, at most 256 MB.
    """

    def __init__(self, scenes: Scene | Sequence[Scene], num_threads: int | None = None, *, memory: int | None = None):
        each = (scenes,) if isinstance(scenes, Articulation) else scenes
        self.scenes = tuple(require_bodies(scene, "A simulation") for scene in each)
        _check_topology(self.scenes)
        self.scene = self.scenes[0]
        num_threads = usable_cores() if num_threads is None else num_threads
        check_counts(num_threads=num_threads)
        self.num_threads = num_threads
        self.memory = min(2**23 * num_threads, 2**28) if memory is None else memory
        self._pool = Rollout(nthread=num_threads if num_threads > 1 else 0)
        self._data = [mujoco.MjData(self.scene.model) for _ in range(num_threads)]
        self._times = self.scene.delays.times(self.scene.model)  # indices of times in physics, the present first
        self.start_poses: dict[int, Any] = {}  # by variant of an MJCF model, made at its first draw
        self.control_limits: dict[float, Any] = {}  # by knot interval, for MJCF models, found at first use

    @cached_property
    def without_mocap_actions(self) -> Simulator:
        """A simulator with the actuators' actions alone; this one if there are no others."""
        if not len(self.scene.mocaps):
            return self
        scenes = [scene.without_mocap_actions for scene in self.scenes]
        return Simulator(scenes, self.num_threads, memory=self.memory)

    def rollout(
        self, physics: Tensor | np.ndarray, actions: Tensor | np.ndarray, variant: Tensor | np.ndarray | None = None
    ) -> TensorDict:
        """Simulate action sequences from given states, without gradients.

        Args:
            physics: ``[*B, S]`` float64, full MuJoCo states (``mjSTATE_FULLPHYSICS``).
            actions: ``[*B, T, A]`` floating point, one per control step, or ``[*B, T, substeps, A]``, one per physics
                step, as for commands that act late.
            variant: ``[*B]`` integers, scene of each sequence; default: the scenes in turn.

        Returns:
            TensorDict ``[*B]`` of ``state`` ``[*B, T+1, N, C]`` and ``physics`` ``[*B, T+1, S]``, float64, both
            starting with the given states, and ``stable`` ``[*B]`` bool. Quaternion signs are MuJoCo's.
        """
        scene = self.scene
        start = self._checked_physics(physics)
        controls = _as_array(actions, "actions")
        if not np.issubdtype(controls.dtype, np.floating):
            raise TypeError(f"actions must be floating point, got {controls.dtype}")
        batch = start.shape[:-1]
        within = controls.ndim == len(batch) + 3  # one per physics step
        held = scene.substeps
        ends = (held, scene.num_actions) if within else (scene.num_actions,)
        steps = controls.shape[len(batch)] if controls.ndim > len(batch) else 0
        if controls.shape != (*batch, steps, *ends):
            expected = ", ".join([*map(str, batch), "T", *map(str, ends)])
            raise ValueError(f"actions of {scene.name!r} must be [{expected}], got {list(controls.shape)}")
        require_finite(controls, "actions")
        which = self._variants(variant, batch)
        count = len(which)
        start = start.reshape(count, scene.physics_size)
        controls = controls.reshape(count, steps * (held if within else 1), scene.num_actions)
        controls = controls.astype(np.float64, copy=False)

        state = np.empty((count, steps + 1, scene.num_nodes, scene.state_size))
        recorded = np.empty((count, steps + 1, scene.physics_size))
        stable = np.empty(count, dtype=bool)
        for rows in self._chunks(count, steps * held + 1):
            # Sensors show the state before a physics step: one extra step shows the last state.
            repeated = controls[rows] if within else np.repeat(controls[rows], held, axis=1)
            last = controls[rows, -1:] if steps else np.tile(self.scene.rest_action, (len(repeated), 1, 1))
            held_controls = np.concatenate([repeated, last], axis=1)
            after, sensors, stable[rows] = self._advance(start[rows], held_controls, which[rows])
            recorded[rows, 0] = start[rows]
            recorded[rows, 1:] = after[:, held - 1 :: held][:, :steps]
            state[rows] = scene.states(sensors[:, ::held], recorded[rows])
        arrays = {"state": state, "physics": recorded, "stable": stable}
        result = {name: torch.from_numpy(array.reshape((*batch, *array.shape[1:]))) for name, array in arrays.items()}
        return TensorDict(result, batch_size=batch)

    def observe(self, physics: Tensor | np.ndarray, variant: Tensor | np.ndarray | None = None) -> Tensor:
        """Return body states ``[*B, N, C]`` of physics ``[*B, S]``, equal to those of :meth:`rollout`."""
        start = self._checked_physics(physics)
        batch = start.shape[:-1]
        which = self._variants(variant, batch)
        state = np.empty((len(which), self.scene.num_nodes, self.scene.state_size))
        data = self._data[0]
        for row, values in enumerate(start.reshape(len(which), self.scene.physics_size)):
            model = self.scenes[which[row]].model
            mujoco.mj_setState(model, data, values, _PHYSICS)
            for stage in ("kinematics", "comPos", "comVel", "sensorPos", "sensorVel"):
                getattr(mujoco, f"mj_{stage}")(model, data)
            state[row] = self.scene.states(data.sensordata, values)
        return torch.from_numpy(state.reshape(*batch, *state.shape[1:]))

    def step(
        self, physics: np.ndarray, actions: np.ndarray, variant: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Advance states ``[n, S]``, float64, by one control step with actions ``[n, A]``, float64.

        Skips the extra physics step by which :meth:`rollout` observes the last state and checks its stability.

        Returns:
            Next states ``[n, S]``, NaN where unstable, and body states before the step ``[n, N, C]``, float64.
        """
        scene = self.scene
        start = self._checked_physics(physics, finite=False)
        which = self._variants(variant, start.shape[:-1])
        if actions.shape != (expected := (*start.shape[:-1], scene.num_actions)):
            raise ValueError(f"actions of {scene.name!r} must be {list(expected)}, got {list(actions.shape)}")
        after, state = np.empty_like(start), np.empty((len(start), scene.num_nodes, scene.state_size))
        for rows in self._chunks(len(start), scene.substeps):
            held = np.repeat(actions[rows, None], scene.substeps, axis=1)
            path, sensors, stable = self._advance(start[rows], held, which[rows])
            after[rows] = np.where(stable[:, None], path[:, -1], np.nan)
            state[rows] = scene.states(sensors[:, 0], start[rows])
        return after, state

    def settle(
        self, physics: np.ndarray, steps: int, variant: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Simulate physics steps without control; return states ``[n, S]`` with the old time, and stability ``[n]``."""
        start = self._checked_physics(physics)
        which = self._variants(variant, start.shape[:-1])
        settled, stable = np.empty_like(start), np.empty(len(start), dtype=bool)
        for rows in self._chunks(len(start), steps + 1):
            controls = np.tile(self.scene.rest_action, (len(start[rows]), steps + 1, 1))
            after, _, stable[rows] = self._advance(start[rows], controls, which[rows])
            settled[rows] = after[:, -2]
        settled[:, self._times] -= settled[:, :1] - start[:, :1]
        settled[:, 0] = start[:, 0]
        return settled, stable

    def _advance(
        self, start: np.ndarray, controls: np.ndarray, which: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return physics ``[n, t, S]`` after, sensors ``[n, t, nsensordata]`` before each step; stability ``[n]``."""
        # MuJoCo resets unstable simulations to time 0: start above 0 to detect it.
        zero, given = start[:, 0] == 0, start
        if zero.any():
            start = start.copy()
            start[np.ix_(zero, self._times)] += 1.0
        with quiet_mujoco():
            after, sensors = self._pool.rollout(
                [self.scenes[i].model for i in which] if len(self.scenes) > 1 else self.scene.model,
                self._data,
                start,
                self.scene.mocaps.inputs(self.scene.model, controls) if self.scene.num_actions else None,
                nstep=controls.shape[1],
                control_spec=self.scene.mocaps.control_spec,
            )
        timestep = self.scene.model.opt.timestep
        time = np.concatenate([start[:, :1], after[:, :, 0]], axis=1)
        stable = (np.diff(time, axis=1) > 0.5 * timestep).all(axis=1)
        # Comparisons with NaN are false.
        stable &= (np.abs(start) <= _HUGE).all(axis=1) & (np.abs(after) <= _HUGE).all(axis=(1, 2))
        # Sum in MuJoCo's order, for equal rounding.
        sums = np.cumsum(np.full(after.shape[1], timestep))
        after[zero, :, 0] = sums
        if len(self._times) > 1:  # buffers of delayed controls keep the given times before the start
            past = after[zero][..., self._times[1:]] - 1.0
            when = np.concatenate([np.zeros(1), sums])[np.rint(past / timestep).astype(int).clip(0, len(sums))]
            before = given[zero][:, None, self._times[1:]]
            after[np.ix_(zero, np.arange(len(sums)), self._times[1:])] = np.where(past < -timestep / 2, before, when)
        return after, sensors, stable

    def _chunks(self, count: int, steps: int) -> Iterator[slice]:
        row = 8 * (self.scene.model.nsensordata + self.scene.physics_size + self.scene.num_actions)
        size = max(self.num_threads, self.memory // (row * steps))
        return (slice(first, min(first + size, count)) for first in range(0, count, size))

    def _checked_physics(self, physics: Tensor | np.ndarray, *, finite: bool = True) -> np.ndarray:
        array = _as_array(physics, "physics")
        if array.dtype != np.float64:
            raise TypeError(f"physics must be float64 to keep every digit, got {array.dtype}")
        if array.ndim < 1 or array.shape[-1] != self.scene.physics_size:
            expected = f"[*B, {self.scene.physics_size}]"
            raise ValueError(f"physics of {self.scene.name!r} must be {expected}, got {list(array.shape)}")
        if finite:
            require_finite(array, "physics")
        return array

    def _variants(self, variant: Tensor | np.ndarray | None, batch: tuple[int, ...]) -> np.ndarray:
        count = int(np.prod(batch, dtype=np.int64))
        if variant is None:
            return np.arange(count) % len(self.scenes)
        which = _as_array(variant, "variant")
        if which.shape != batch or not np.issubdtype(which.dtype, np.integer):
            raise ValueError(f"variant must be {list(batch)} integers, got {list(which.shape)} of {which.dtype}")
        if count and not (which.min() >= 0 and which.max() < len(self.scenes)):
            raise ValueError(f"variant must lie in [0, {len(self.scenes)}), got {which.min()} to {which.max()}")
        return which.reshape(count)


def _as_array(value: Tensor | np.ndarray, name: str) -> np.ndarray:
    if isinstance(value, Tensor):
        return value.detach().cpu().numpy()
    if isinstance(value, np.ndarray):
        return value
    raise TypeError(f"{name} must be a tensor or an array, got {type(value).__name__}")


def _check_topology(scenes: tuple[Scene, ...]) -> None:
    if not scenes:
        raise ValueError("A simulator needs at least one scene.")
    first = scenes[0]
    for i, scene in enumerate(scenes[1:], start=1):
        for what in (
            "node_names",
            "joint_names",
            "action_names",
            "action_low",
            "action_high",
            "substeps",
            "timestep",
            "physics_size",
            "senders",
            "mocap_poses",
        ):
            ours, theirs = getattr(first, what), getattr(scene, what)
            if not np.array_equal(ours, theirs):
                raise ValueError(
                    f"Scenes simulated together must have equal topology, but {what} of scene 0 ({first.name!r})"
                    f" is {ours} and of scene {i} ({scene.name!r}) {theirs}."
                )
