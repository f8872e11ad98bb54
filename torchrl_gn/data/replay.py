"""Replay buffer that draws transitions and windows from whole trajectories."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer, TensorStorage
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.writers import ImmutableDatasetWriter, TensorDictRoundRobinWriter

from torchrl_gn.checks import check_count, check_counts, checked_seed
from torchrl_gn.scenes.checked_trajectories import check_episodes, require_trajectories

_KEYS = ("state", "action", "parameters", "smoothed")


def trajectory_buffer(
    trajectories: TensorDictBase,
    *,
    batch_size: int,
    window: int = 1,
    seed: int | None = None,
    capacity: int | None = None,
    query_windows: tuple[int, int] | None = None,
    shard: tuple[int, int] = (0, 1),
) -> TensorDictReplayBuffer:
    """Make a replay buffer that draws transitions, or windows of them, from trajectories without copying these.

    Draws (trajectory, start time) uniformly with replacement. ``sample()`` gives a TensorDict ``[batch_size]``, or
    ``[batch_size, window]`` for windows longer than one, of ``state``, ``action``, ``("next", "state")``, ``index``
    ``[..., 2]`` (trajectory, time) and ``parameters``. ``buffer[i]`` gives whole trajectories.

    Args:
        trajectories: ``[M]`` of ``state`` ``[M, T+1, ...]``, ``action`` ``[M, T, A]`` and optionally ``parameters`` (a
            tensor ``[M, ...]`` or a TensorDict ``[M]``) and ``smoothed`` (like ``state``, see
            :func:`log_trajectories`), from which next states are then read; other entries are ignored.
        batch_size: number of draws in a sample.
        window: consecutive transitions in a draw.
        seed: seed of the draws; default: drawn from torch's global generator.
        capacity: number of trajectories to allocate, so that ``extend`` can add more and replace the oldest; default:
            read-only. ``extend`` raises ValueError or KeyError for trajectories of another kind.
        query_windows: ``(count, length)`` of windows at other times of the same trajectory to append to each draw,
            ``[batch_size, window + count * length]`` (paper, SM "End-to-end training algorithm for System ID").
        shard: ``(rank, size)``: return only this rank's equal part of each draw; ranks with equal seeds make equal
            draws.
    """
    require_trajectories(trajectories)
    check_counts(batch_size=batch_size, window=window)
    if capacity is not None:
        check_count("capacity", capacity, 1)
    if query_windows is not None:
        for name, value in zip(("query_windows[0]", "query_windows[1]"), query_windows, strict=True):
            check_count(name, value, 1)
    for name, value in zip(("shard[0]", "shard[1]"), shard, strict=True):
        check_count(name, value, 0)
    if shard[0] >= shard[1]:
        raise ValueError(f"shard must be a rank and a size above it, got {shard}")
    if batch_size % shard[1]:
        raise ValueError(f"batch_size={batch_size} cannot be split evenly among {shard[1]} processes; use a multiple")
    trajectories = _checked(trajectories, max(window, query_windows[1] if query_windows else 1))
    if capacity is None:
        storage, writer = TrajectoryStorage(trajectories), ImmutableDatasetWriter()
    elif capacity < len(trajectories):
        raise ValueError(f"capacity is {capacity}, but {len(trajectories)} trajectories are given")
    else:
        room = trajectories.apply(lambda x: x.new_zeros(capacity, *x.shape[1:]), batch_size=[capacity])
        storage, writer = TrajectoryStorage(room, writable=True), TrajectoryWriter()
    sampler = WindowSampler(window, seed, query_windows=query_windows, shard=shard)
    buffer = TensorDictReplayBuffer(storage=storage, sampler=sampler, writer=writer, batch_size=batch_size)
    if capacity is not None:
        buffer.extend(trajectories.copy())
    return buffer


class TrajectoryStorage(TensorStorage):
    """TorchRL storage of whole trajectories ``[M]``, read by (trajectory, time); starts empty if ``writable``."""

    def __init__(self, trajectories: TensorDictBase, *, writable: bool = False):
        super().__init__(trajectories, device=cast(Tensor, trajectories["state"]).device)
        self.writable = writable
        if writable:
            self._len = 0

    @property
    def trajectories(self) -> TensorDictBase:
        return cast(TensorDictBase, self._storage)

    @property
    def steps(self) -> int:
        return self.trajectories.get("action").shape[1]

    def get(self, index: Any) -> TensorDictBase:
        """Return transitions at ``(trajectory, time)``, each ``[B]`` or ``[B, W]``, or whole trajectories."""
        if isinstance(index, Tensor) and index.ndim > 1:  # from a ReplayBufferEnsemble
            index = index.unbind(-1)
        if not isinstance(index, tuple):
            return super().get(cast(Any, index))
        trajectory, time = index
        stored = self.trajectories
        row = trajectory * (self.steps + 1) + time
        next_state = "smoothed" if "smoothed" in stored else "state"
        entries = {
            "state": _rows(stored.get("state"), row),
            "action": _rows(stored.get("action"), trajectory * self.steps + time),
            "next": TensorDict({"state": _rows(stored.get(next_state), row + 1)}, batch_size=row.shape),
        }
        if (parameters := stored.get("parameters", None)) is not None:
            row_parameters = parameters[trajectory if trajectory.ndim == 1 else trajectory[:, :1]]
            entries["parameters"] = row_parameters.expand(*trajectory.shape, *parameters.shape[1:])
        return TensorDict(entries, batch_size=row.shape, device=stored.device)

    def set(self, cursor: Any, data: TensorDictBase, *, set_cursor: bool = True) -> None:
        super().set(cursor, data.select(*self.trajectories.keys()), set_cursor=set_cursor)

    def fitting(self, data: TensorDictBase) -> TensorDict:
        """Return the entries to store of trajectories ``[K]``, or one ``[]``, in the dtypes of those here.

        KeyError if one is missing; ValueError for another shape, which an assignment would repeat or refuse midway, or
        if an episode ends inside.
        """
        check_episodes(data if data.batch_dims else data.unsqueeze(0))
        entries = {}
        for key, stored in self.trajectories.items(True, True):
            if (value := data.get(key, None)) is None:
                raise KeyError(f"trajectories have no {key!r}, which those in the buffer have")
            if value.shape != (shape := (*data.shape, *stored.shape[1:])):
                raise ValueError(f"{key!r} must be {list(shape)} as in the buffer, got {list(value.shape)}")
            entries[key] = value.to(stored.dtype)
        return TensorDict(entries, data.shape)

    def state_dict(self) -> dict[str, Any]:
        return super().state_dict() if self.writable else {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        if self.writable:
            super().load_state_dict(state_dict)


class TrajectoryWriter(TensorDictRoundRobinWriter):
    """TorchRL writer that checks trajectories before it moves on; see :meth:`TrajectoryStorage.fitting`."""

    _storage: TrajectoryStorage

    def add(self, data: TensorDictBase) -> int | Tensor:
        return super().add(self._storage.fitting(data))

    def extend(self, data: TensorDictBase) -> Tensor:
        return super().extend(self._storage.fitting(data))


class WindowSampler(Sampler):
    """TorchRL sampler of (trajectory, time) of a :class:`TrajectoryStorage`, uniform over all windows."""

    def __init__(
        self,
        window: int = 1,
        seed: int | None = None,
        *,
        query_windows: tuple[int, int] | None = None,
        shard: tuple[int, int] = (0, 1),
    ):
        self.window, self.query_windows, self.shard = window, query_windows, shard
        seed = int(torch.randint(2**62, ())) if seed is None else checked_seed(seed)
        self._generator = torch.Generator().manual_seed(seed)

    def sample(self, storage: TrajectoryStorage, batch_size: int) -> tuple[tuple[Tensor, Tensor], dict]:
        """Draw ``batch_size`` windows; return (trajectory, time) of this shard, ``[B]`` or ``[B, W]``; no metadata."""
        starts = storage.steps - self.window + 1
        if not len(storage):
            raise RuntimeError("The buffer has no trajectory yet: extend it first.")
        drawn = torch.randint(len(storage) * starts, (batch_size,), generator=self._generator, device="cpu")
        trajectory = drawn.div(starts, rounding_mode="floor")
        time = drawn - trajectory * starts
        if self.window > 1 or self.query_windows:
            time = time[:, None] + torch.arange(self.window, device="cpu")
            if self.query_windows:
                time = torch.cat((time, self._query_windows(time[:, 0], storage.steps)), dim=1)
            trajectory = trajectory[:, None].expand_as(time)
        rank, size = self.shard
        rank_rows = slice(rank * batch_size // size, (rank + 1) * batch_size // size)
        return (trajectory[rank_rows], time[rank_rows]), {}

    def _query_windows(self, start: Tensor, steps: int) -> Tensor:
        assert self.query_windows is not None
        count, length = self.query_windows
        starts = steps - length + 1
        drawn = torch.randint(max(starts - 1, 1), (len(start), count), generator=self._generator, device="cpu")
        drawn = drawn + (drawn >= start[:, None]) if starts > 1 else drawn
        return (drawn[..., None] + torch.arange(length, device="cpu")).flatten(1)

    def _empty(self) -> None:
        pass  # draws are independent

    def state_dict(self) -> dict[str, Any]:
        return {"generator": self._generator.get_state()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._generator.set_state(state_dict["generator"])

    def dumps(self, path: str) -> None:
        raise NotImplementedError("Save state_dict() instead.")

    def loads(self, path: str) -> None:
        raise NotImplementedError("Use load_state_dict() instead.")


def _rows(values: Tensor, row: Tensor) -> Tensor:
    """Select flat positions ``row`` from the first two dimensions of ``values`` ``[M, T, ...]``."""
    flat, row_shape = values.flatten(0, 1).flatten(1), row.shape
    if values.device.type == "cpu":
        # np.take uses one thread; index_select uses all for a megabyte, a hundred times slower on busy cores.
        numbers = flat.view(torch.int16) if flat.dtype == torch.bfloat16 else flat  # which NumPy lacks
        picked = torch.from_numpy(np.take(numbers.numpy(), row.reshape(-1).numpy(), axis=0)).view(flat.dtype)
    else:
        picked = flat.index_select(0, row.reshape(-1).to(flat.device))
    return picked.view(*row_shape, *values.shape[2:])


def _checked(trajectories: TensorDictBase, window: int) -> TensorDictBase:
    for key in ("state", "action"):
        if key not in trajectories:
            raise KeyError(f"trajectories have no {key!r}, only {sorted(map(str, trajectories.keys()))}")
    check_episodes(trajectories)
    trajectories = trajectories.select(*_KEYS, strict=False)
    state, action = trajectories.get("state"), trajectories.get("action")
    shapes = f"got state {list(state.shape)} and action {list(action.shape)}"
    if trajectories.batch_dims != 1 or state.ndim < 3 or action.ndim != 3:
        raise ValueError(f"trajectories must be [M] of state [M, T+1, ...] and action [M, T, A], {shapes}")
    if state.shape[1] != action.shape[1] + 1:
        raise ValueError(f"a trajectory has one state more than actions, {shapes}")
    if (smoothed := trajectories.get("smoothed", None)) is not None and smoothed.shape != state.shape:
        raise ValueError(f"smoothed states must be {list(state.shape)} as the states, got {list(smoothed.shape)}")
    if not len(trajectories):
        raise ValueError("there is no trajectory to sample from")
    if action.shape[1] < window:
        raise ValueError(f"window is {window} transitions, but the trajectories have {action.shape[1]}")
    # Samples are gathered from flat views, which strided tensors lack.
    return trajectories.apply(lambda x: x.detach().resolve_neg().contiguous())
