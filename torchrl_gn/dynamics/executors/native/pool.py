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
        free, self.free = self.free, []  # other threads find none meanwhile
        for index, buffer in enumerate(free):
            if count <= buffer.numel() <= 2 * count and buffer.dtype == dtype:
                self.free = [each for other, each in enumerate(free) if other != index]
                return Lease(self, buffer)
        return Lease(self, torch.empty(count, dtype=dtype, device="cpu"))


class Lease:
    """A buffer that goes back to its pool with this object."""

    def __init__(self, pool: Pool, tensor: Tensor) -> None:
        self.pool, self.tensor = pool, tensor

    def __del__(self) -> None:
        self.pool.free = [*self.pool.free[-1:], self.tensor]
