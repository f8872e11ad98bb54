"""A lower bound on the time of a step on this processor."""

from __future__ import annotations

import functools
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import torch
from torch import Tensor

from _common.speed_measure import timed
from torchrl_gn.dynamics import SpecializedPredictor
from torchrl_gn.networks.packed_layers import PackedLayers

_SIZE = 512  # rows and columns of the product's matrices, which fit the cache
_READS = 20
_ROUNDS = 10  # other processes only lower a measured rate: take the highest of many


@dataclass(frozen=True)
class Bound:
    """A lower bound: a step multiplies no faster than one large product, and reads its weights at least once."""

    flop: float  # of one sample, in the specialised network
    rate: float  # FLOP/s
    size: float  # bytes of the specialised network's weights and tables
    bandwidth: float  # bytes/s

    @classmethod
    def measure(cls, model: SpecializedPredictor, repeats: int) -> Bound:
        """Measure the bound in the model's dtype, in ``repeats`` rounds of short measurements."""
        dtype, repeats = model.dtype, _ROUNDS * repeats
        size = _weight_bytes(model.program().core)
        rate = max(gemm_rate(_SIZE, _SIZE, dtype, fast, repeats) for fast in (False, True))
        return cls(1e3 * model.skipped()["kFLOP"][1], rate, size, read_rate(size, repeats))

    def milliseconds(self, batch: int) -> float:
        return 1e3 * max(batch * self.flop / self.rate, self.size / self.bandwidth)

    def __str__(self) -> str:
        return (
            f"{self.flop / 1e3:,.0f} kFLOP a sample at {self.rate / 1e9:.0f} GFLOP/s,"
            f" {self.size / 1e6:.2f} MB of weights at {self.bandwidth / 1e9:.0f} GB/s"
        )


def gemm_rate(rows: int, size: int, dtype: torch.dtype, fast: bool, repeats: int) -> float:
    """Measure the highest FLOP/s of a product of ``[rows, size]`` and ``[size, size]`` matrices."""
    a, b = torch.randn(rows, size).to(dtype), torch.randn(size, size).to(dtype)
    return 2 * rows * size * size / min(timed(functools.partial(torch.mm, a, b), fast)[1] for _ in range(repeats))


def read_rate(size: float, repeats: int) -> float:
    """Measure the highest bytes/s of reading an array of ``size`` bytes repeatedly, by its sum."""
    array = torch.ones(int(size) // 4)

    def read() -> None:
        for _ in range(_READS):
            array.sum()

    return _READS * 4 * len(array) / min(timed(read, False)[1] for _ in range(repeats))


def _weight_bytes(core: Any) -> int:
    """Count the bytes of a folded core's weights and tables, without padding and transposes.

    The core's own tensors do not count: they are incidence matrices, which index lists can replace.
    """
    if isinstance(core, PackedLayers):  # it also holds padding and every weight's transpose
        shapes, tables = core.shapes.tables, core.tables.element_size()
        sizes = [rows * columns * tables for rows, columns in zip(shapes[::2], shapes[1::2], strict=True)]
        return sum(sizes) + sum(map(_bytes, core.plain_weights()))
    parts = [getattr(core, field.name) for field in fields(core)]
    return sum(_bytes(part) for part in parts if not isinstance(part, Tensor))


def _bytes(value: Any) -> int:
    if isinstance(value, Tensor):
        return value.numel() * value.element_size()
    if is_dataclass(value):
        value = tuple(getattr(value, field.name) for field in fields(value))
    return sum(map(_bytes, value)) if isinstance(value, tuple) else 0
