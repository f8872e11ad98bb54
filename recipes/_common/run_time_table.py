"""Table, figure and metrics of run time against error, for each number of threads."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from torch import Tensor

from torchrl_gn.evaluation import plot_loglog
from torchrl_gn.training import RunFolder


@dataclass
class Method:
    """A method to predict states ``[B, T + 1, N, 13]`` from physics states ``[B, S]``, states and controls.

    Attributes:
        name: name of the method.
        family: name of the methods that one line of a figure joins.
        run: the prediction.
        error: error of the predictions.
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
    """Print a table and draw a figure, with Pareto fronts, for every number of threads; return all metrics.

    A single number of threads is the metric ``"threads"``; several are part of the names of run times.
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
    """Return the names of the Pareto-optimal points, where smaller is better in both coordinates."""
    return {
        name
        for name, (x, y) in points.items()
        if math.isfinite(y) and not any(a <= x and b <= y and (a, b) != (x, y) for a, b in points.values())
    }
