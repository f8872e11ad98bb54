"""Run time against error: a table, a figure and metrics of each number of threads."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from torch import Tensor

from torchrl_gn.evaluation import plot_loglog
from torchrl_gn.training import RunFolder


@dataclass
class Method:
    """A way to predict states ``[B, T + 1, N, 13]`` from physics states ``[B, S]``, states and controls.

    Attributes:
        name: of the method.
        family: of methods that one line of a figure joins.
        run: the prediction.
        error: of its predictions.
        seconds: wall seconds per simulated second, by number of threads and batch size.
    """

    name: str
    family: str
    run: Callable[[Tensor, Tensor, Tensor], Tensor]
    error: float = math.nan
    seconds: dict[tuple[int, int], float] = field(default_factory=dict)


def report(
    methods: Sequence[Method], counts: Sequence[int], batches: Sequence[int], run: RunFolder
) -> dict[str, float | int]:
    """Print a table and draw a figure of every number of threads, with its own Pareto fronts, and return all numbers.

    With one number of threads, it is the metric ``"threads"``; with several, names of run times have it.
    """
    metrics: dict[str, float | int] = {f"{method.name}/error": method.error for method in methods}
    if len(counts) == 1:
        metrics["threads"] = counts[0]
    for count in counts:
        threads = f"{count} thread" + "s" * (count > 1)
        of = f", {threads}" if len(counts) > 1 else ""
        panels: dict[str, dict[str, tuple[list[float], list[float]]]] = {}
        print(f"{threads:38}{'error':>10}" + "".join(f"{f'batch {batch}':>14}" for batch in batches))
        fronts = {batch: pareto({m.name: (m.seconds[count, batch], m.error) for m in methods}) for batch in batches}
        for method in methods:
            cells = ""
            for batch in batches:
                seconds = method.seconds[count, batch]
                cells += f"{seconds:13.2e}{'*' if method.name in fronts[batch] else ' '}"
                metrics[f"{method.name}{of}/batch {batch}/seconds_per_simulated_second"] = seconds
                panel = panels.setdefault(f"s per simulated s, batch {batch}, {threads}", {})
                line = panel.setdefault(method.family, ([], []))
                line[0].append(seconds)
                line[1].append(method.error)
            print(f"{method.name:38}{method.error:10.1e}{cells}")
        figure = f"work_precision{of.replace(', ', '_').replace(' ', '_')}.png"
        plot_loglog(panels, run.file(figure), ylabel="error over equal simulated time")
    return metrics


def pareto(points: dict[str, tuple[float, float]]) -> set[str]:
    """Names of the points that no other beats in both coordinates."""
    return {
        name
        for name, (x, y) in points.items()
        if math.isfinite(y) and not any(a <= x and b <= y and (a, b) != (x, y) for a, b in points.values())
    }
