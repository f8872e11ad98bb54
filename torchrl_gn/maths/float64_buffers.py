"""Modules whose buffers keep their dtype."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn


class Float64Buffers(nn.Module):
    """Module whose tensors keep their dtype when an enclosing network is cast; they do change device with it."""

    def constants(self, values: Mapping[str, Any]) -> None:
        """Register arrays or tensors as buffers that checkpoints leave out."""
        for name, value in values.items():
            # Not a view of a larger or transposed array: torch.export warns that it cannot save it whole.
            self.register_buffer(name, torch.as_tensor(value).contiguous(), persistent=False)

    def _apply(self, fn, recurse: bool = True):
        def keep_dtype(tensor: Tensor) -> Tensor:
            applied = fn(tensor)
            return applied if applied.dtype == tensor.dtype else tensor.to(applied.device)

        return super()._apply(keep_dtype, recurse)
