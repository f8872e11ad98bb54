"""The table of run times."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import cast

from omegaconf import DictConfig

from _common.speed_bound import Bound
from _common.speed_measure import Way, Work
from torchrl_gn.dynamics import SpecializedPredictor

# Heads and number formats of columns, by metric.
_COLUMNS = {
    "milliseconds": ("ms", ".3f"),
    "speedup": ("/reference", ".1f"),
    "jraph": ("/jraph", ".2f"),
    "bound": ("bound", ".0%"),
    "megabytes": ("MB", ".1f"),
    "error": ("error", ".1e"),
}


def least_times(cfg: DictConfig, works: Sequence[Work], ways: Mapping[str, Way]) -> dict[tuple[str, str], float]:
    """Return lower bounds on a step's time, ms, by work and predictor, in the predictor's dtype; print their terms."""
    least = {}
    for dtype, kind in {"float32": "specialised", "bfloat16": "specialised, bfloat16"}.items():
        if kind not in ways:
            continue
        bound = Bound.measure(cast(SpecializedPredictor, ways[kind].model), cfg.repeats)
        print(f"Bound of a step in {dtype}: {bound}")
        for work, batch in zip(works, cfg.batches, strict=False):  # steps come first
            names = [name for name in work.milliseconds if ("bfloat16" in name) == (dtype == "bfloat16")]
            least |= {(work.name, name): bound.milliseconds(batch) for name in names if name != "mujoco"}
    return least


def report(works: Sequence[Work], least: Mapping[tuple[str, str], float]) -> dict[str, float]:
    """Print one row for each work and predictor; return their metrics, named ``work/predictor/metric``."""
    metrics = {}
    print(f"  {'':24}" + "".join(f"{head:>12}" for head, _ in _COLUMNS.values()))
    for work in works:
        print(work.name)
        medians = {name: statistics.median(values) for name, values in work.milliseconds.items()}
        for name, values in work.milliseconds.items():
            median = medians[name]
            row = {"milliseconds": median, "speedup": medians["reference"] / median}
            row |= {"jraph": medians["jraph"] / median} if "jraph" in medians else {}
            row |= {"bound": least[work.name, name] / median} if (work.name, name) in least else {}
            row |= {"megabytes": work.megabytes[name]}
            row |= {"error": work.errors[name]} if name in work.errors else {}
            cells = [f"{row[key]:{shape}}" if key in row else "" for key, (_, shape) in _COLUMNS.items()]
            print(f"  {name:24}" + "".join(f"{cell:>12}" for cell in cells))
            row["range"] = (max(values) - min(values)) / median
            metrics |= {f"{work.name}/{name}/{key}": number for key, number in row.items()}
    return metrics
