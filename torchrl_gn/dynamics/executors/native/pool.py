"""Memory that is used again."""

from __future__ import annotations

import torch
from torch import Tensor


class Pool:
    """Buffers that are used again: fresh pages cost as much as filling them."""

    def __init__(self) -> None:
        self.free: list[Tensor] = []

    def take(self, count: int, dtype: torch.dtype) -> Lease:
        """A buffer of at least ``count`` numbers."""
        for _ in range(len(self.free)):
            try:
                buffer = self.free.pop(0)  # in one go: no other thread can take it too
            except IndexError:
                break
            if count <= buffer.numel() <= 2 * count and buffer.dtype == dtype:
                return Lease(self, buffer)
            self.free.append(buffer)
        return Lease(self, torch.empty(count, dtype=dtype, device="cpu"))


class Lease:
    """A buffer that goes back to its pool with this object."""

    def __init__(self, pool: Pool, tensor: Tensor) -> None:
        self.pool, self.tensor = pool, tensor

    def __del__(self) -> None:
        self.pool.free.append(self.tensor)
        del self.pool.free[:-2]
