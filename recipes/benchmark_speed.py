"""Run time of the forward model: specialised and plain, the same work in turn.

    python recipes/benchmark_speed.py [system=swimmer6] [hidden=[128,128]] [compile=true] [curves=true]

Measures one step, rollouts, gradients through rollouts and a training step of one forward model (random weights,
true static features) as it is evaluated in different ways: `plain` (PyG message passing, eager: the rival),
`folded` (what training uses), `specialised`, and on top of it oneDNN's matrix products (`fast`), bfloat16
products (where this processor is fast at them) and `torch.compile`. Each way does each piece of work in turn,
several times; the table shows medians, speed-ups over `plain` and errors against the plain model in float64. The
share of the limit is that of the specialised model's FLOPs at the rate of a large matrix product measured beside it.
`curves=true` draws the cost of a step over links, batch sizes and hidden sizes, and of a rollout's gradient over its
length. Takes about ten minutes, half of it compiling; results: docs/performance.md.

Writes config.yaml, metrics.json and with curves the figure speed.png to its run folder.
"""

from __future__ import annotations

import contextlib
import copy
import ctypes
import functools
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar, cast

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict
from torch import Tensor
from tqdm import tqdm

from torchrl_gn.data import collect_trajectories, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel, Predictor, specialize
from torchrl_gn.evaluation import plot_loglog
from torchrl_gn.maths import fast_matmul
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.processor import product_speeds
from torchrl_gn.scenes import ParameterNames, load_scene
from torchrl_gn.training import RunFolder, Tracker, clean_exit, make_optimizer, with_help

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


def make_model(cfg: DictConfig, system: str, hidden: list[int]) -> tuple[ForwardModel, TensorDict]:
    """Random weights with the normalisers of a short collection, and its transitions."""
    scene = load_scene(system)
    trajectories = collect_trajectories(scene, 64, 64, cfg.seed)
    transitions = cast(TensorDict, trajectory_buffer(trajectories, batch_size=64 * 64, seed=cfg.seed).sample())
    torch.manual_seed(cfg.seed)
    edges = hidden if cfg.edge_hidden is None else list(cfg.edge_hidden)
    sizes = {"edge_hidden": edges, "node_hidden": hidden, "global_hidden": hidden, "latent": cfg.latent}
    model = ForwardModel(ParameterNames.of(scene), activation=cfg.activation, **sizes)
    ForwardModelLoss(model.bind(scene)).fit_normalizers(transitions)
    return model, transitions


def make_ways(cfg: DictConfig, model: ForwardModel, system: str) -> dict[str, Way]:
    """All ways, the rival first."""
    scene = load_scene(system)
    bound = model.bind(scene)
    ways = {
        "plain": Way(model.bind(scene, plain=True)),
        "plain, fast": Way(model.bind(scene, plain=True), fast=True),
        "folded, fast": Way(bound, fast=True),
        "specialised": Way(specialize(bound)),
        "specialised, fast": Way(specialize(bound), fast=True),
    }
    rounded = product_speeds().pays(torch.bfloat16)
    if rounded:
        ways["specialised, bfloat16"] = Way(specialize(bound, dtype=torch.bfloat16))
    if cfg.compile:
        compiled = specialize(bound, compile=True)
        ways["compiled"] = Way(compiled)
        ways["compiled, fast"] = Way(compiled, fast=True)
        if rounded:
            ways["compiled, bfloat16"] = Way(specialize(bound, dtype=torch.bfloat16, compile=True))
    return ways


@torch.no_grad()
def step_once(model: Predictor, state: Tensor, action: Tensor) -> Tensor:
    """Next state."""
    return model.step(state, action)


def pull(model: Predictor, state: Tensor, actions: Tensor) -> Tensor:
    """Gradient of a rollout to its actions."""
    leaf = actions.clone().requires_grad_()
    model.rollout(state, leaf)[..., 7:].square().sum().backward()
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
                return way.model.rollout(state, actions)[:, -1] - state

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


def measure(works: list[Work], ways: dict[str, Way], reference: Predictor | None) -> dict[str, float]:
    """Time every work in every way, in turn; returns the seconds of first calls of compiled ways."""
    compile_seconds = {}
    bar = tqdm(total=sum(work.repeats + 1 for work in works) * len(ways), desc="measuring", leave=False)
    for work in works:
        expected = None if reference is None else work.run(Way(reference))
        for turn in range(work.repeats + 1):
            for name, way in ways.items():
                result, seconds = timed(functools.partial(work.run, way), way.fast)
                bar.update()
                if turn == 0:  # warms up, compiles
                    if name == "compiled":
                        compile_seconds[work.name] = seconds
                    if result is not None and expected is not None:
                        work.errors[name] = float((result - expected).norm() / expected.norm())
                else:
                    work.milliseconds.setdefault(name, []).append(1e3 * seconds / work.steps)
        for name, way in ways.items():
            work.megabytes[name] = peak_memory(functools.partial(timed, functools.partial(work.run, way), way.fast))
    bar.close()
    return compile_seconds


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
    """FLOP/s of a product as large as the model's largest."""
    a, b = torch.randn(rows, size).to(dtype), torch.randn(size, size).to(dtype)
    seconds = [timed(functools.partial(torch.mm, a, b), fast)[1] for _ in range(repeats + 1)]
    return 2 * rows * size * size / statistics.median(seconds[1:])


def limits(cfg: DictConfig, ways: dict[str, Way], work: Work, batch: int) -> dict[str, float]:
    """Share of the limit that each way reaches: FLOPs of the specialised function at the measured product rate."""
    shares = {}
    for name, way in ways.items():
        if not name.startswith(("specialised", "compiled")):
            continue
        quick = way.model
        edges, size = quick.scene.num_edges, cfg.hidden[-1]
        dtype = torch.bfloat16 if "bfloat16" in name else torch.float32
        rate = gemm_rate(batch * edges, size, dtype, way.fast, cfg.repeats)
        flop = 1e3 * quick.skipped()["kFLOP"][1] * batch  # type: ignore[attr-defined]
        shares[name] = flop / rate / (1e-3 * statistics.median(work.milliseconds[name]))
    return shares


def curves(cfg: DictConfig) -> dict[str, dict[str, tuple[list[float], list[float]]]]:
    """Milliseconds of a step against links, batch and hidden size, and of gradients against horizons."""
    panels: dict[str, dict[str, tuple[list[float], list[float]]]] = {}
    points = [("links, batch 100", f"swimmer{links}", 100, 128, links) for links in cfg.curve_links]
    points += [("batch", cfg.system, batch, 128, batch) for batch in cfg.curve_batches]
    points += [("hidden size, batch 100", cfg.system, 100, hidden, hidden) for hidden in cfg.curve_hidden]
    points += [("horizon, batch 100, with gradient", cfg.system, 100, 128, steps) for steps in cfg.curve_horizons]
    for panel, system, batch, hidden, x in tqdm(points, desc="curves", leave=False):
        model, transitions = make_model(cfg, system, [hidden, hidden])
        bound = model.bind(load_scene(system))
        ways = {
            "plain": Way(model.bind(bound.scene, plain=True)),
            "specialised": Way(specialize(bound)),
            "specialised, fast": Way(specialize(bound), fast=True),
        }
        model.requires_grad_(False)
        state, action = transitions["state"][:batch], transitions["action"][:batch]
        for name, way in ways.items():
            if panel.startswith("horizon"):
                run = functools.partial(pull, way.model, state, action.unsqueeze(1).expand(-1, x, -1))
            else:
                run = functools.partial(step_once, way.model, state, action)
            seconds = [timed(run, way.fast)[1] for _ in range(max(4, cfg.repeats // 2))]
            line = panels.setdefault(panel, {}).setdefault(name, ([], []))
            line[0].append(x)
            line[1].append(1e3 * statistics.median(seconds[1:]))
    return panels


@with_help
@hydra.main(config_path="config", config_name="benchmark_speed", version_base="1.3")
@clean_exit
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(cfg.threads)
    torch.manual_seed(cfg.seed)
    run = RunFolder(cfg.run_dir, "benchmark_speed")
    run.write_config(OmegaConf.to_yaml(cfg, resolve=True))
    tracker = Tracker(cfg.logger, run.path / "log", name="benchmark_speed", config=cfg)
    model, transitions = make_model(cfg, cfg.system, list(cfg.hidden))
    ways, works = make_ways(cfg, model, cfg.system), make_works(cfg, model, transitions)
    model.requires_grad_(False)
    reference = copy.deepcopy(model).double().bind(load_scene(cfg.system), plain=True)
    compile_seconds = measure(works, ways, reference)
    model.requires_grad_(True)
    training = train_work(cfg, model, transitions)
    measure([training], {name: way for name, way in ways.items() if "plain" in name or "folded" in name}, None)

    print(ways["specialised"].model)
    print(
        f"\nMilliseconds a step, median of {cfg.repeats}, {cfg.threads} threads; speed-up over plain; most MB of"
        " memory; error"
    )
    metrics: dict[str, float | int] = {"threads": cfg.threads}
    for work in [*works, training]:
        print(work.name)
        rival = statistics.median(work.milliseconds["plain"])
        for name, values in work.milliseconds.items():
            median = statistics.median(values)
            error = f"{work.errors[name]:11.1e}" if name in work.errors else ""
            print(f"  {name:24}{median:10.3f}{rival / median:8.1f}x{work.megabytes[name]:9.1f}{error}")
            metrics[f"{work.name}/{name}/megabytes"] = work.megabytes[name]
            metrics[f"{work.name}/{name}/milliseconds"] = median
            metrics[f"{work.name}/{name}/speedup"] = rival / median
            metrics[f"{work.name}/{name}/spread"] = (max(values) - min(values)) / median
            if name in work.errors:
                metrics[f"{work.name}/{name}/error"] = work.errors[name]
    batch = max(cfg.batches)
    widest = next(work for work in works if work.name == f"step, batch {batch}")
    print(f"Share of the limit, step, batch {batch}")
    for name, share in limits(cfg, ways, widest, batch).items():
        print(f"  {name:24}{100 * share:10.0f} %")
        metrics[f"limit/{name}"] = share
    for name, seconds in compile_seconds.items():
        metrics[f"first call/{name}"] = seconds
    if compile_seconds:
        print("First calls of the compiled model: " + ", ".join(f"{n} {s:.0f} s" for n, s in compile_seconds.items()))
    if cfg.curves:
        panels = curves(cfg)
        for panel, lines in panels.items():
            for name, (xs, ys) in lines.items():
                metrics.update({f"curve/{panel}/{name}/{x}": y for x, y in zip(xs, ys, strict=True)})
        plot_loglog(panels, run.file("speed.png"), ylabel="milliseconds")
    tracker.finish(run.write_metrics(metrics, seed=cfg.seed), run.written)
    for path in run.written:
        print(path)


if __name__ == "__main__":
    main()
