"""Data-parallel processes, as `torchrun` starts them."""

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

# Other processes wait while rank 0 collects data or evaluates.
_TIMEOUT = timedelta(hours=12)


@dataclass(frozen=True)
class Workers:
    """Processes that train together, as seen by this one."""

    rank: int = 0  # of this process
    size: int = 1  # number of processes

    @property
    def first(self) -> bool:
        """True on rank 0, which writes files, shows progress and validates."""
        return self.rank == 0

    @property
    def shard(self) -> tuple[int, int]:
        """Rank and size, for :func:`~torchrl_gn.data.trajectory_buffer`."""
        return self.rank, self.size

    def agree(self, make: Callable[[], T]) -> T:
        """Call ``make`` on rank 0 only, and broadcast its result."""
        if self.size == 1:
            return make()
        shared = [make() if self.first else None]
        dist.broadcast_object_list(shared, 0)
        return cast(T, shared[0])

    def mean(self, number: float) -> float:
        """Average a number over processes; not finite if any is not."""
        if self.size == 1:
            return number
        shared = torch.tensor(number, dtype=torch.float64)
        dist.all_reduce(shared)
        return float(shared) / self.size

    def any(self, mine: bool) -> bool:
        """Return True if ``mine`` is true on any process."""
        return self.mean(float(mine)) > 0

    def device(self, name: str) -> torch.device:
        """Return this process's device: ``"cuda"`` means one GPU per process. ValueError if there is no such device."""
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
                    f"device={name} is GPU {local}, but there are {count}, counted from 0; name one of them, and start"
                    f" at most {count} processes per machine."
                )
            device = torch.device("cuda", local)
            torch.cuda.set_device(device)
        return device

    def wait(self) -> None:
        """Wait until all processes get here."""
        if self.size > 1:
            dist.barrier()

    @contextmanager
    def first_goes_first(self) -> Iterator[None]:
        """Run the block on rank 0 first, then on the others."""
        if not self.first:
            self.wait()
        yield
        if self.first:
            self.wait()

    def wrap(self, module: nn.Module) -> nn.Module:
        """Return the module with gradients averaged over processes; all start from rank 0's weights and buffers."""
        if self.size == 1:
            return module
        if "forward_sync_buffers" in inspect.signature(DistributedDataParallel).parameters:
            return DistributedDataParallel(module, forward_sync_buffers=False)
        for buffer in module.buffers():  # older versions of torch cannot sync only at the start, without every step
            dist.broadcast(buffer, 0)
        return DistributedDataParallel(module, broadcast_buffers=False)


@contextmanager
def join_workers() -> Iterator[Workers]:
    """Join the process group of `torchrun`, if there is one; leave it at the end."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield Workers()
        return
    dist.init_process_group(timeout=_TIMEOUT)  # gloo on CPUs, NCCL on GPUs
    try:
        yield Workers(dist.get_rank(), dist.get_world_size())
    finally:
        dist.destroy_process_group()
