"""Limits on the size of networks that are built from untrusted descriptions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

_MOST_EACH, _MOST_TOGETHER = 100_000, 1_000_000  # limits on a network description's whole numbers: each, sum
_DESCRIBED_APART = ("scene", "kinematic_tree")  # entries that scene_from_description limits
_FREE_BYTES, _RATIO = 16_000_000, 4  # allowance for constants; factor, as half precision is built in single
_EACH = 4_096  # bytes that Python takes for a tensor, its module and their names
_FACTORIES = {torch.empty, torch.zeros, torch.ones, torch.full, torch.rand, torch.randn, torch.eye, torch.arange}


class MemoryLimit(TorchFunctionMode):
    """Context manager that limits the memory of new tensors according to the weights in a file.

    Args:
        size: bytes of the weights.
        count: number of weight tensors.

    Raises:
        ValueError: at the first tensor beyond the limit.
    """

    def __init__(self, size: int, count: int) -> None:
        super().__init__()
        self.size, self.room = size, _FREE_BYTES + _RATIO * (size + count * _EACH)

    def __torch_function__(self, func: Callable, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        made = func(*args, **(kwargs or {}))
        if func in _FACTORIES and isinstance(made, Tensor) and not made.is_meta:
            self.room -= made.untyped_storage().nbytes() + _EACH
            if self.room < 0:
                raise ValueError(f"its description gives a far larger network than its {self.size:,} bytes of weights")
        return made


def check_whole_numbers(description: Any) -> None:
    """Raise ValueError if the description of a network, apart from its scenes, has impossibly large numbers."""
    together = 0
    for number in _whole_numbers(description):
        together += abs(number)
        if abs(number) > _MOST_EACH or together > _MOST_TOGETHER:
            raise ValueError(f"its description has numbers too large for a network, such as {number}")


def _whole_numbers(value: Any) -> Iterator[int]:
    pending = [value]
    while pending:
        entry = pending.pop()
        if isinstance(entry, dict):
            pending += [inner for name, inner in entry.items() if name not in _DESCRIBED_APART]
        elif isinstance(entry, list):
            pending += entry
        elif isinstance(entry, int) and not isinstance(entry, bool):
            yield entry
