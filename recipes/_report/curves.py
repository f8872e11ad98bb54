"""Learning curves of a claim's tasks beside peers' published means, for its figure and tables.

The curves come from the claim's runs, of recipes/shac.py, added as TASK-SEED. Its ``peers`` describe published means:
``sources`` has where each peer's come from and over how many seeds; ``returns`` has pairs of frames and mean return, by
task and peer. A table with ``"curves": [frames, ...]`` lists our returns at these frames, and at the last of them the
return with a planner (if a run has one, of ``plan=true``), the best peer and our minutes; its last row has the means of
all tasks. A table with ``"peers": true`` lists the sources. recipes/suite.py makes the same table and figure of new
runs.
"""

from __future__ import annotations

import math
import re
import statistics
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypedDict

import numpy as np
from scipy.stats import trim_mean

NONE = "-"  # a cell without a run
LEAST_BAND = 3  # with at least this many seeds, an interval replaces single seeds
_CUT = 0.25  # share of the scores that the interquartile mean leaves out at each end, rounded down to whole scores
_TASK_SEED = re.compile(r"(.+)-(\d+)")

Claim = Mapping[str, Any]  # the content of its file
Line = Sequence[tuple[float, float]]  # frames and return


class CurvePanel(TypedDict):
    """Lines of a task's panel."""

    seeds: list[Line]
    mean: Line
    band: list[tuple[float, float, float]]  # frames, low and high
    planned: Line  # the planner's mean at the end of the mean; empty unless all seeds have one
    peers: dict[str, Line]


@dataclass(frozen=True)
class Curve:
    """Rounds of a run: frames so far, the median return of the last five rounds, and processor minutes so far."""

    frames: Sequence[int]
    returns: Sequence[float]
    minutes: Sequence[float]
    planned: float | None = None  # return of a planner that starts from the last policy

    def round_at(self, frames: float) -> int | None:
        """Return the last round at or before ``frames``; None before the first round or after the end of the run."""
        index = bisect_right(self.frames, frames) - 1
        length = self.frames[-1] - self.frames[-2] if len(self.frames) > 1 else 1
        return index if 0 <= index and frames < self.frames[-1] + length else None


def curve_of(metrics: Mapping[str, Any]) -> Curve:
    """Return the curve in the metrics of a run of recipes/shac.py."""
    rounds = [f"round {index}" for index in range(len(metrics)) if f"round {index}/frames" in metrics]
    names = "frames", "median_return_of_last_five", "minutes"
    columns = [[metrics[f"{each}/{name}"] for each in rounds] for name in names]
    return Curve(*columns, planned=metrics.get("planned/return"))


def curves_of(claim: Claim) -> dict[str, list[Curve]]:
    """Return the curves of the claim's runs by task, in order, one for each seed.

    Raises:
        ValueError: if there is no run, or one that is not named as a task and a seed, or without rounds.
    """
    curves: dict[str, dict[int, Curve]] = {}
    for name, run in claim.get("runs", {}).items():
        if not (match := _TASK_SEED.fullmatch(name)):
            raise ValueError(f"the run {name} must name a task and a seed; add it as=cheetah-run-0, say.")
        curve = curves.setdefault(match[1], {})[int(match[2])] = curve_of(run["metrics"])
        if not curve.frames:
            raise ValueError(f"the run {name} has no rounds; add one of recipes/shac.py.")
    if not curves:
        raise ValueError("there is no run; add one: report.py add=RUN to=CLAIM as=cheetah-run-0.")
    return {task: [by_seed[seed] for seed in sorted(by_seed)] for task, by_seed in sorted(curves.items())}


def curve_table(claim: Claim, frames: Sequence[int]) -> dict[str, Any]:
    """Return columns and rows of a table of the claim's curves at ``frames``, compared with peers at the last."""
    at = f"{frames[-1]:,}"
    ours = curves_of(claim)
    plans = any(curve.planned is not None for curves in ours.values() for curve in curves)
    columns = ["task", "seeds", *(f"at {each:,}" for each in frames), *([f"at {at}, planned"] if plans else [])]
    columns += [f"best peer at {at}", f"minutes for {at}"]
    tasks = [_TaskNumbers.of(curves, claim["peers"]["returns"].get(task, {}), frames) for task, curves in ours.items()]
    rows = [_row(titled(task), numbers, plans=plans) for task, numbers in zip(ours, tasks, strict=True)]
    if len(tasks) > 1:
        rows.append(_row(f"mean of {len(tasks)} tasks", _TaskNumbers.mean(tasks), plans=plans))
    return {"columns": columns, "rows": rows}


@dataclass(frozen=True)
class _TaskNumbers:
    """Numbers of a row: means over a task's seeds, or of these means over all tasks."""

    seeds: int
    returns: Sequence[float | None]  # at each number of frames; None if a seed was not run as far
    planned: float | None
    peers: Mapping[str, float]  # at the last number of frames
    minutes: float | None

    @classmethod
    def of(cls, curves: Sequence[Curve], peers: Mapping[str, Line], frames: Sequence[int]) -> _TaskNumbers:
        returns = [mean_at(curves, each) for each in frames]
        published = {name: value for name, line in peers.items() for at, value in line if at == frames[-1]}
        return cls(len(curves), returns, planned_mean(curves), published, mean_at(curves, frames[-1], "minutes"))

    @classmethod
    def mean(cls, tasks: Sequence[_TaskNumbers]) -> _TaskNumbers:
        """Return the means over tasks; without a number, or a peer, that a task lacks."""
        names = [name for name in tasks[0].peers if all(name in task.peers for task in tasks)]
        return cls(
            sum(task.seeds for task in tasks),
            [_mean(values) for values in zip(*(task.returns for task in tasks), strict=True)],
            _mean([task.planned for task in tasks]),
            {name: statistics.fmean(task.peers[name] for task in tasks) for name in names},
            _mean([task.minutes for task in tasks]),
        )

    @property
    def best_peer(self) -> tuple[str, float] | None:
        """Name and return of the best peer."""
        return max(self.peers.items(), key=lambda peer: peer[1], default=None)

    @property
    def best(self) -> float | None:
        """Our return at the last number of frames, or the planner's, if that is higher."""
        return None if self.returns[-1] is None else max(self.returns[-1], self.planned or -math.inf)


def _mean(values: Sequence[float | None]) -> float | None:
    """Return the mean; None if a value is."""
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known and len(known) == len(values) else None


def _row(label: str, numbers: _TaskNumbers, *, plans: bool) -> list[str]:
    returns = [*numbers.returns, *([numbers.planned] if plans else [])]
    best, last = numbers.best_peer, len(numbers.returns) - 1
    cells = [NONE if value is None else f"{value:.0f}" for value in returns]
    peer = f"{best[0]} {best[1]:.0f}" if best else NONE
    if returns[last] is not None and best is not None:
        level = round(best[1])
        shown = {at: round(value) for at, value in enumerate(returns) if at >= last and value is not None}
        for at, value in shown.items():
            cells[at] = f"**{cells[at]}**" if value >= level else cells[at]
        peer = peer if max(shown.values()) > level else f"**{peer}**"
    minutes = numbers.minutes
    return [label, str(numbers.seeds), *cells, peer, NONE if minutes is None else f"{minutes:.0f}"]


def peer_table(claim: Claim) -> dict[str, Any]:
    """Return columns and rows of a table of the sources of the peers' means."""
    rows = []
    for name, source in claim["peers"]["sources"].items():
        repository, commit, path = (source[key] for key in ("repository", "commit", "path"))
        file = f"[{path}](https://github.com/{repository}/blob/{commit}/{path})"
        rows.append([name, source["paper"], str(source["seeds"]), repository, file, commit[:7]])
    return {"columns": ["peer", "paper", "seeds", "repository", "file", "commit"], "rows": rows}


def ahead(claim: Claim, frames: int) -> str:
    """Count the tasks on which our mean is above every peer's at ``frames``, out of those run so far ("3 of 5").

    It is the policy's mean or, at the end of all runs, the planner's, if that is higher; both are rounded, as shown.
    """
    tasks = _numbers_at(claim, frames)
    compared = [(task.best, task.best_peer) for task in tasks if task.best is not None and task.best_peer is not None]
    return f"{sum(round(ours) > round(peer[1]) for ours, peer in compared)} of {len(compared)}"


def mean_return(claim: Claim, frames: int, of: str) -> str:
    """Return the mean over all tasks at ``frames``: of our policy, with a planner, or the best peer's.

    Args:
        claim: the claim.
        frames: number of frames.
        of: ``"policy"``, ``"planned"`` or ``"best_peer"``, which gives its name, too.

    Raises:
        ValueError: if a task lacks this number.
    """
    mean = _TaskNumbers.mean(_numbers_at(claim, frames))
    peer = mean.best_peer
    value = {"policy": mean.returns[-1], "planned": mean.planned, "best_peer": peer and peer[1]}[of]
    if value is None:
        raise ValueError(f"a task has no return of {of} at {frames:,} frames.")
    return f"{peer[0]} {value:.0f}" if peer and of == "best_peer" else f"{value:.0f}"


def _numbers_at(claim: Claim, frames: int) -> list[_TaskNumbers]:
    peers = claim["peers"]["returns"]
    return [_TaskNumbers.of(curves, peers.get(task, {}), [frames]) for task, curves in curves_of(claim).items()]


def curve_panels(claim: Claim) -> dict[str, CurvePanel]:
    """Return the panels of the claim's figure by task."""
    peers = claim["peers"]["returns"]
    return {titled(task): curve_panel(curves, peers.get(task, {})) for task, curves in curves_of(claim).items()}


def curve_panel(curves: Sequence[Curve], peers: Mapping[str, Line]) -> CurvePanel:
    """Return a task's panel: the mean as far as all seeds run, and the seeds, or an interval of three seeds or more."""
    seeds = [list(zip(curve.frames, curve.returns, strict=True)) for curve in curves]
    frames = sorted({at for curve in curves for at in curve.frames})
    means = [(at, mean) for at in frames if (mean := mean_at(curves, at)) is not None]
    band: list[tuple[float, float, float]] = []
    if len(curves) >= LEAST_BAND:
        band = [(at, *interquartile_interval(values_at(curves, at))) for at, _ in means]
    planned = planned_mean(curves)
    return {
        "seeds": [] if band else [_rounded(each) for each in seeds],
        "mean": _rounded(means),
        "band": [(at, round(low, 1), round(high, 1)) for at, low, high in band],
        "planned": [] if planned is None or not means else _rounded([(means[-1][0], planned)]),
        "peers": dict(peers),
    }


def mean_at(curves: Sequence[Curve], frames: float, what: str = "returns") -> float | None:
    """Return the mean over seeds of ``returns`` or ``minutes`` at ``frames``; None if a seed was not run as far."""
    values = values_at(curves, frames, what)
    return statistics.fmean(values) if len(values) == len(curves) else None


def planned_mean(curves: Sequence[Curve]) -> float | None:
    """Return the mean over seeds of the planner's return; None unless all seeds have one."""
    return _mean([curve.planned for curve in curves])


def interquartile_mean(*tasks: Sequence[float]) -> float:
    """Return the mean of the middle half of all runs' scores, a sequence for each task (Agarwal et al. 2021)."""
    return float(trim_mean(np.concatenate(tasks), _CUT))


def interquartile_interval(
    *tasks: Sequence[float], level: float = 0.95, samples: int = 2000, seed: int = 0
) -> tuple[float, float]:
    """Return the bootstrap interval of the interquartile mean of all runs' scores (Agarwal et al. 2021).

    Each of ``samples`` draws as many scores of every task, with replacement. The interval lies between percentiles of
    the samples' interquartile means and holds the share ``level`` of them. Calls with as many scores share their draws.

    Args:
        *tasks: scores of each task's runs.
        level: share of the samples inside.
        samples: number of samples.
        seed: seed of the draws.
    """
    generator = np.random.default_rng(seed)
    drawn = [np.asarray(each)[generator.integers(len(each), size=(samples, len(each)))] for each in tasks]
    low, high = np.quantile(trim_mean(np.hstack(drawn), _CUT, axis=1), [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def titled(task: str) -> str:
    """Return a task's name in words."""
    return re.sub("[-_]", " ", task)


def values_at(curves: Sequence[Curve], frames: float, what: str = "returns") -> list[float]:
    """Return ``returns`` or ``minutes`` at ``frames`` of the seeds that were run as far."""
    rounds = [(curve, curve.round_at(frames)) for curve in curves]
    return [getattr(curve, what)[index] for curve, index in rounds if index is not None]


def _rounded(line: Line) -> Line:
    return [(at, round(value, 1)) for at, value in line]
