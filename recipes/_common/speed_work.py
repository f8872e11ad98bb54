"""Work to time on a forward model: steps, rollouts, gradients and training steps."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar, cast

import torch
from omegaconf import DictConfig
from tensordict import TensorDict
from torch import Tensor

from torchrl_gn.dynamics import ForwardModel, Predictor
from torchrl_gn.maths import fast_matmul
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.training import make_optimizer

R = TypeVar("R")


@dataclass(frozen=True)
class Way:
    """A way to evaluate the forward model."""

    model: Predictor
    fast: bool = False


@dataclass
class Work:
    """Something to time: ``run`` does it with a way and gives a result to compare."""

    name: str
    run: Callable[[Way], Tensor | None]
    steps: int = 1
    repeats: int = 9
    milliseconds: dict[str, list[float]] = field(default_factory=dict)
    errors: dict[str, float] = field(default_factory=dict)
    megabytes: dict[str, float] = field(default_factory=dict)


def peak_memory(run: Callable[[], object]) -> float:
    """Most memory that ``run`` takes beyond what was taken before, in MB; NaN where Linux does not tell."""

    def resident(name: str) -> int:
        status = Path("/proc/self/status").read_text()
        return int(next(line for line in status.splitlines() if line.startswith(name)).split()[1])

    try:
        ctypes.CDLL(None).malloc_trim(0)  # gives back what is free
        Path("/proc/self/clear_refs").write_text("5")  # resets the high-water mark
    except (OSError, AttributeError):
        return math.nan
    before = resident("VmRSS")
    run()
    return (resident("VmHWM") - before) / 1024


def timed(run: Callable[[], R], fast: bool) -> tuple[R, float]:
    """What ``run`` gives, and the seconds it takes, with products that may round if ``fast``."""
    with fast_matmul(rounding=True) if fast else contextlib.nullcontext():
        start = time.perf_counter()
        result = run()
        return result, time.perf_counter() - start


@torch.no_grad()
def step_once(model: Predictor, state: Tensor, action: Tensor) -> Tensor:
    """Next state."""
    return model.step(state, action)[0]


def pull(model: Predictor, state: Tensor, actions: Tensor) -> Tensor:
    """Gradient of a rollout to its actions."""
    leaf = actions.clone().requires_grad_()
    model.rollout(state, leaf)[0][..., 7:].square().sum().backward()
    assert leaf.grad is not None
    return leaf.grad


def make_works(cfg: DictConfig, model: ForwardModel, transitions: TensorDict) -> list[Work]:
    """The work of the table, but for the training step."""

    def first(batch: int, horizon: int = 1) -> tuple[Tensor, Tensor]:
        count = batch * horizon
        actions = cast(Tensor, transitions["action"]).repeat(-(-count // len(transitions)), 1)[:count]
        return cast(Tensor, transitions["state"])[:batch], actions.view(batch, horizon, -1)

    def step(batch: int) -> Work:
        state, actions = first(batch)

        def run(way: Way) -> Tensor:
            return step_once(way.model, state, actions[:, 0]) - state

        return Work(f"step, batch {batch}", run, repeats=cfg.repeats)

    def rollout(batch: int, horizon: int) -> Work:
        state, actions = first(batch, horizon)

        def run(way: Way) -> Tensor:
            with torch.no_grad():
                return way.model.rollout(state, actions)[0][:, -1] - state

        return Work(f"rollout of {horizon}, batch {batch}", run, horizon, cfg.repeats)

    def gradient(batch: int, horizon: int) -> Work:
        state, actions = first(batch, horizon)

        def run(way: Way) -> Tensor:
            return pull(way.model, state, actions)

        return Work(f"gradient of {horizon}, batch {batch}", run, horizon, cfg.repeats)

    return [
        *(step(batch) for batch in cfg.batches),
        *(rollout(batch, cfg.horizon) for batch in cfg.rollout_batches),
        *(gradient(batch, cfg.gradient_horizon) for batch in cfg.gradient_batches),
    ]


def train_work(cfg: DictConfig, model: ForwardModel, transitions: TensorDict) -> Work:
    """A whole training step: loss, gradient and optimiser."""
    batch = transitions[: cfg.training_batch]
    optimizer = make_optimizer(model.core, cfg.optimizer)
    losses: dict[int, ForwardModelLoss] = {}

    def run(way: Way) -> None:
        loss = losses.setdefault(id(way), ForwardModelLoss(way.model))
        optimizer.zero_grad()
        loss(batch)["loss_forward_model"].backward()
        optimizer.step(0, 1.0)  # the schedule has ended: the weights stay as they are

    return Work(f"training step, batch {cfg.training_batch}", run, repeats=cfg.repeats)


def gemm_rate(rows: int, size: int, dtype: torch.dtype, fast: bool, repeats: int) -> float:
    """Median FLOP/s of a product of ``[rows, size]`` and ``[size, size]`` matrices."""
    a, b = torch.randn(rows, size).to(dtype), torch.randn(size, size).to(dtype)
    seconds = [timed(functools.partial(torch.mm, a, b), fast)[1] for _ in range(repeats + 1)]
    return 2 * rows * size * size / statistics.median(seconds[1:])
