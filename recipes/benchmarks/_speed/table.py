"""The table of run times, and the lower bound on a step's time on this processor that it compares them with."""

from __future__ import annotations

import functools
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, cast

import torch
from omegaconf import DictConfig
from torch import Tensor

from _speed.measure import Method, Workload, timed
from torchrl_gn.dynamics import SpecializedPredictor
from torchrl_gn.networks.packed_layers import PackedLayers

# Heads and number formats of columns, by metric.
_COLUMNS = {
    "milliseconds": ("ms", ".3f"),
    "speedup": ("/reference", ".1f"),
    "jraph": ("/jraph", ".2f"),
    "bound": ("bound", ".0%"),
    "megabytes": ("MB", ".1f"),
    "error": ("error", ".1e"),
}
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


def least_times(
    cfg: DictConfig, workloads: Sequence[Workload], methods: Mapping[str, Method]
) -> dict[tuple[str, str], float]:
    """Return lower bounds on a step's time, ms, by workload and predictor, in its dtype; print their terms."""
    least = {}
    for dtype, kind in {"float32": "specialised", "bfloat16": "specialised, bfloat16"}.items():
        if kind not in methods:
            continue
        bound = Bound.measure(cast(SpecializedPredictor, methods[kind].model), cfg.repeats)
        print(f"Least time of a step in {dtype} on this machine: {bound}")
        for workload, batch in zip(workloads, cfg.batches, strict=False):  # steps come first
            names = [name for name in workload.milliseconds if ("bfloat16" in name) == (dtype == "bfloat16")]
            least |= {(workload.name, name): bound.milliseconds(batch) for name in names if name != "mujoco"}
    return least


def report(workloads: Sequence[Workload], least: Mapping[tuple[str, str], float]) -> dict[str, float]:
    """Print one row for each workload and predictor; return their metrics, named ``workload/predictor/metric``."""
    metrics = {}
    print(f"  {'':24}" + "".join(f"{head:>12}" for head, _ in _COLUMNS.values()))
    for workload in workloads:
        print(workload.name)
        medians = {name: statistics.median(values) for name, values in workload.milliseconds.items()}
        for name, values in workload.milliseconds.items():
            median = medians[name]
            row = {"milliseconds": median, "speedup": medians["reference"] / median}
            row |= {"jraph": medians["jraph"] / median} if "jraph" in medians else {}
            row |= {"bound": least[workload.name, name] / median} if (workload.name, name) in least else {}
            row |= {"megabytes": workload.megabytes[name]}
            row |= {"error": workload.errors[name]} if name in workload.errors else {}
            cells = [f"{row[key]:{shape}}" if key in row else "" for key, (_, shape) in _COLUMNS.items()]
            print(f"  {name:24}" + "".join(f"{cell:>12}" for cell in cells))
            row["range"] = (max(values) - min(values)) / median
            metrics |= {f"{workload.name}/{name}/{key}": number for key, number in row.items()}
    return metrics
