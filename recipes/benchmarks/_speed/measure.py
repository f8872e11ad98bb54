"""Time workloads of a forward model, in turn."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar, cast

from tensordict import TensorDict
from torch import Tensor
from tqdm import tqdm

from torchrl_gn.dynamics import Predictor
from torchrl_gn.dynamics.program import PreparedStep
from torchrl_gn.maths import fast_matmul

R = TypeVar("R")

# A short workload is repeated within a turn, as its first call finds the caches full of others' data.
_TURN_SECONDS, _MOST_CALLS = 0.02, 50


class OwnParameters:
    """A predictor bound with a ``parameters_key``, for batches whose samples have their own parameters."""

    def __init__(self, predictor: Predictor, parameters: TensorDict) -> None:
        self._predictor, self._parameters = predictor, parameters
        self._of_batch: dict[int, PreparedStep] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._predictor, name)

    def __str__(self) -> str:
        return str(self._predictor)

    def step(self, state: Tensor, action: Tensor) -> tuple[Tensor, Any]:
        return self._first(len(state)).step(state, action)

    def rollout(self, state: Tensor, actions: Tensor) -> tuple[Tensor, Any]:
        return self._first(len(state)).rollout(state, actions)

    def _first(self, count: int) -> PreparedStep:
        # Folded once, as planners do.
        if count not in self._of_batch:
            self._of_batch[count] = self._predictor.prepared(cast(TensorDict, self._parameters[:count].clone()))
        return self._of_batch[count]


@dataclass(frozen=True)
class Method:
    """A predictor to time; with ``fast``, its matrix products may round."""

    model: Predictor
    fast: bool = False

    def with_parameters(self, parameters: TensorDict | None) -> Method:
        """Return the predictor for samples with their own physical ``parameters``; if these are None, return itself."""
        if parameters is None:
            return self
        return replace(self, model=cast(Predictor, OwnParameters(self.model, parameters)))


@dataclass
class Workload:
    """A workload to time.

    Attributes:
        name: name of the workload.
        run: the workload, given a predictor.
        steps: steps of the model in it, by which times are divided.
        repeats: turns that are timed.
        others: the same workload of baselines, by name.
        compared: the part of a result that errors are computed from.
        milliseconds: times of a step in every turn, by name.
        errors: relative errors against the reference, by name.
        megabytes: peak memory, by name.
    """

    name: str
    run: Callable[[Method], Any]
    steps: int = 1
    repeats: int = 9
    others: Mapping[str, Callable[[], object]] = field(default_factory=dict)
    compared: Callable[[Any], Tensor] = lambda result: result
    milliseconds: dict[str, list[float]] = field(default_factory=dict)
    errors: dict[str, float] = field(default_factory=dict)
    megabytes: dict[str, float] = field(default_factory=dict)


def peak_memory(run: Callable[[], object]) -> float:
    """Return the peak memory of ``run`` above the memory before it, in MB; NaN if the system does not report it."""

    def resident(name: str) -> int:
        status = Path("/proc/self/status").read_text()
        return int(next(line for line in status.splitlines() if line.startswith(name)).split()[1])

    try:
        ctypes.CDLL(None).malloc_trim(0)  # returns free memory to the system
        Path("/proc/self/clear_refs").write_text("5")  # resets the high-water mark
    except (OSError, AttributeError):
        return math.nan
    before = resident("VmRSS")
    run()
    return (resident("VmHWM") - before) / 1024


def timed(run: Callable[[], R], fast: bool) -> tuple[R, float]:
    """Return the result and the seconds of ``run``; with ``fast``, matrix products may round."""
    with fast_matmul(rounding=True) if fast else contextlib.nullcontext():
        start = time.perf_counter()
        result = run()
        return result, time.perf_counter() - start


def measure(
    workloads: Sequence[Workload], methods: Mapping[str, Method], reference: Method | None = None
) -> dict[str, float]:
    """Time all workloads with all predictors, in turn; return the seconds of the compiled predictor's first calls."""
    compile_seconds = {}
    turns = sum((workload.repeats + 1) * (len(methods) + len(workload.others)) for workload in workloads)
    bar = tqdm(total=turns, desc="measuring", leave=False)
    for workload in workloads:
        expected = None if reference is None else workload.compared(workload.run(reference))
        runs = {
            name: functools.partial(timed, functools.partial(workload.run, method), method.fast)
            for name, method in methods.items()
        }
        runs |= {name: functools.partial(timed, run, False) for name, run in workload.others.items()}
        calls: dict[str, int] = {}
        for name, run in runs.items():  # warms up, compiles
            result, seconds = run()
            bar.update()
            if name == "compiled":
                compile_seconds[workload.name] = seconds
            if name in methods and expected is not None:
                workload.errors[name] = float((workload.compared(result) - expected).norm() / expected.norm())
            calls[name] = max(1, min(_MOST_CALLS, int(_TURN_SECONDS / run()[1])))
        for _ in range(workload.repeats):
            for name, run in runs.items():
                seconds = statistics.median(run()[1] for _ in range(calls[name]))
                workload.milliseconds.setdefault(name, []).append(1e3 * seconds / workload.steps)
                bar.update()
        for name, run in runs.items():
            workload.megabytes[name] = peak_memory(run)
    bar.close()
    return compile_seconds
