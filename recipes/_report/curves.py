"""Learning curves of a claim's tasks beside peers' published means, for its figure and tables.

The curves come from the claim's runs, of recipes/shac.py, added as TASK-SEED. Its ``peers`` describe published means:
``sources`` has where each peer's come from and over how many seeds; ``returns`` has pairs of frames and mean return, by
task and peer. A table with ``"curves": [frames, ...]`` lists our returns at these frames, and at the last of them the
return with a planner (if a run has one, of ``plan=true``), the best peer and our minutes; one with ``"peers": true``
lists the sources.
"""

from __future__ import annotations

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
    return {task: [of[seed] for seed in sorted(of)] for task, of in sorted(curves.items())}


def curve_table(claim: Claim, frames: Sequence[int]) -> dict[str, Any]:
    """Return columns and rows of a table of the claim's curves at ``frames``, compared with peers at the last."""
    at = f"{frames[-1]:,}"
    ours = curves_of(claim)
    plans = any(curve.planned is not None for curves in ours.values() for curve in curves)
    columns = ["task", "seeds", *(f"at {each:,}" for each in frames), *([f"at {at}, planned"] if plans else [])]
    columns += [f"best peer at {at}", f"minutes for {at}"]
    peers = claim["peers"]["returns"]
    rows = [_row(task, curves, peers.get(task, {}), frames, plans=plans) for task, curves in ours.items()]
    return {"columns": columns, "rows": rows}


def _row(
    task: str, curves: Sequence[Curve], peers: Mapping[str, Line], frames: Sequence[int], *, plans: bool
) -> list[str]:
    returns = [mean_at(curves, each) for each in frames]
    best, last = best_peer(peers, frames[-1]), len(frames) - 1
    returns += [planned_mean(curves)] if plans else []
    cells = [NONE if value is None else f"{value:.0f}" for value in returns]
    peer = f"{best[0]} {best[1]:.0f}" if best else NONE
    if returns[last] is not None and best is not None:
        level = round(best[1])
        shown = {at: round(value) for at, value in enumerate(returns) if at >= last and value is not None}
        for at, value in shown.items():
            cells[at] = f"**{cells[at]}**" if value >= level else cells[at]
        peer = peer if max(shown.values()) > level else f"**{peer}**"
    minutes = mean_at(curves, frames[-1], "minutes")
    return [titled(task), str(len(curves)), *cells, peer, NONE if minutes is None else f"{minutes:.0f}"]


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

    It is the policy's mean or, at the end of all runs, the planner's, if that is higher.
    """
    peers, compared, won = claim["peers"]["returns"], 0, 0
    for task, curves in curves_of(claim).items():
        ours, best = mean_at(curves, frames), best_peer(peers.get(task, {}), frames)
        if ours is not None and best is not None:
            compared += 1
            won += max(ours, planned_mean(curves) or ours) > best[1]
    return f"{won} of {compared}"


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
        band = [(at, *interquartile_interval(_values(curves, at))) for at, _ in means]
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
    values = _values(curves, frames, what)
    return statistics.fmean(values) if len(values) == len(curves) else None


def planned_mean(curves: Sequence[Curve]) -> float | None:
    """Return the mean over seeds of the planner's return; None unless all seeds have one."""
    values = [curve.planned for curve in curves if curve.planned is not None]
    return statistics.fmean(values) if len(values) == len(curves) else None


def interquartile_interval(
    scores: Sequence[float], *, level: float = 0.95, samples: int = 2000, seed: int = 0
) -> tuple[float, float]:
    """Return the bootstrap interval of the interquartile mean, the mean of the middle half, of runs' scores.

    Each of ``samples`` draws as many scores, with replacement. The interval lies between percentiles of the samples'
    interquartile means and holds the share ``level`` of them. Calls with as many scores share their draws.
    """
    drawn = np.random.default_rng(seed).integers(len(scores), size=(samples, len(scores)))
    means = trim_mean(np.asarray(scores)[drawn], _CUT, axis=1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def best_peer(peers: Mapping[str, Line], frames: int) -> tuple[str, float] | None:
    """Return name and mean of the peer with the highest return at exactly ``frames``; None without such a return."""
    found = [(name, value) for name, line in peers.items() for at, value in line if at == frames]
    return max(found, key=lambda peer: peer[1], default=None)


def titled(task: str) -> str:
    """Return a task's name in words."""
    return re.sub("[-_]", " ", task)


def _values(curves: Sequence[Curve], frames: float, what: str = "returns") -> list[float]:
    rounds = [(curve, curve.round_at(frames)) for curve in curves]
    return [getattr(curve, what)[index] for curve, index in rounds if index is not None]


def _rounded(line: Line) -> Line:
    return [(at, round(value, 1)) for at, value in line]
