"""Processes that train one model together, as `torchrun` starts them."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import TypeVar, cast

import torch
import torch.distributed as dist
from torch import nn
from torch.nn.parallel import DistributedDataParallel

T = TypeVar("T")

# The others wait while the first collects data or evaluates.
_PATIENCE = timedelta(hours=12)


@dataclass(frozen=True)
class Workers:
    """The processes that train together, of which this is one; by default it is alone.

    Attributes:
        rank: which one this is, from 0.
        size: how many there are.
    """

    rank: int = 0
    size: int = 1

    @property
    def first(self) -> bool:
        """Whether this is the one that writes files, shows progress and validates."""
        return self.rank == 0

    @property
    def shard(self) -> tuple[int, int]:
        """Rank and size, as :func:`~torchrl_gn.data.trajectory_buffer` takes them."""
        return self.rank, self.size

    def agree(self, make: Callable[[], T]) -> T:
        """What ``make`` gives the first one, for all; the others do not call it."""
        if self.size == 1:
            return make()
        shared = [make() if self.first else None]
        dist.broadcast_object_list(shared, 0)
        return cast(T, shared[0])

    def mean(self, number: float) -> float:
        """Mean of everybody's number; not finite if any is not."""
        if self.size == 1:
            return number
        shared = torch.tensor(number, dtype=torch.float64)
        dist.all_reduce(shared)
        return float(shared) / self.size

    def device(self, name: str) -> torch.device:
        """Where this one computes: of several on one machine, each on a GPU of its own.

        Raises:
            ValueError: if there is no such device.
        """
        try:
            device = torch.device(name)
        except RuntimeError as error:
            raise ValueError(f"device={name} is not known; use cpu or cuda.") from error
        if device.type == "cuda":
            if not torch.cuda.is_available():
                raise ValueError(f"device={name} needs a GPU and a torch built for it; use device=cpu.")
            local = int(os.environ.get("LOCAL_RANK", "0")) if device.index is None else device.index
            count = torch.cuda.device_count()
            if local >= count:
                raise ValueError(
                    f"device={name} is GPU {local}, but there are {count}, counted from 0; use one of these, and as"
                    " many processes at most."
                )
            device = torch.device("cuda", local)
            torch.cuda.set_device(device)
        return device

    def wait(self) -> None:
        """Go on when all have come this far."""
        if self.size > 1:
            dist.barrier()

    @contextmanager
    def first_goes_first(self) -> Iterator[None]:
        """The first one runs the block alone, then the others do: it makes what they find."""
        if not self.first:
            self.wait()
        yield
        if self.first:
            self.wait()

    def wrap(self, module: nn.Module) -> nn.Module:
        """The module with gradients averaged over all, its weights and statistics set to the first one's."""
        if self.size == 1:
            return module
        if "forward_sync_buffers" in inspect.signature(DistributedDataParallel).parameters:
            return DistributedDataParallel(module, forward_sync_buffers=False)
        for buffer in module.buffers():  # an older torch has one option for the begin and every step
            dist.broadcast(buffer, 0)
        return DistributedDataParallel(module, broadcast_buffers=False)


@contextmanager
def join_workers() -> Iterator[Workers]:
    """Join the others that `torchrun` started, if it did; leave them in the end.

    Yields:
        Who trains together: with ``torchrun --nproc-per-node 2 recipes/forward_model.py`` two, without it one.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield Workers()
        return
    dist.init_process_group(timeout=_PATIENCE)  # gloo, and NCCL for what is on GPUs
    try:
        yield Workers(dist.get_rank(), dist.get_world_size())
    finally:
        dist.destroy_process_group()
