"""Measure run time against error of learned models and of MuJoCo itself, for one system.

    python recipes/benchmarks/work_precision.py [system=swimmer6] [minutes=4] [sizes=[64,128,256]]
        [mlps=[[512,512,512]]]

Measures these methods on the same rollouts, with starts and random controls as in the data sets:

- GN forward models of several sizes and MLPs, trained here for `minutes` each, or `checkpoints=[FOLDER,...]`; evaluated
  by message passing (reference), specialised and, where this processor is fast at it, specialised in bfloat16
- MuJoCo at its own and at coarser settings

Errors are differences from a finely stepped MuJoCo over equal simulated time, relative to the persistence baseline. Run
time is wall time per simulated second of one trajectory, for every batch size and number of threads (`threads=[1,2]`):
the median of several rounds, each of all methods in turn. A method is on the Pareto front of a batch size and a number
of threads if no other is both faster and more accurate. With several threads, leave out the reference
(`ways=[specialised,bfloat16]`): torch's threads busy-wait after it, and slow the next method down.

Writes config.yaml, metrics.json, the figure work_precision.png (one for each number of threads, if there are several)
and the trained models to its run folder; the same `run_dir` resumes an interrupted run. Results:
docs/results/run-time-against-error.md; when a learned model is the right choice: docs/speed.md.
"""

from __future__ import annotations

import contextlib
import math
import statistics
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import hydra
import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor, nn
from torchrl.modules import MLP
from tqdm import tqdm

sys.path.append(str(Path(__file__).parents[1]))  # where _common is

from _common import as_list, clean_exit, finish_run, open_run, refuse_without_effect, with_help
from _common.options import check_options
from _common.sweeps import FORWARD_MODEL, Run, refuse_failures, run_all
from _timing import time_in_turn
from torchrl_gn.data import Simulator, sample_start_states, spline_controls
from torchrl_gn.dynamics import ForwardModel, Predictor, specialize
from torchrl_gn.evaluation import plot_loglog, squared_errors
from torchrl_gn.maths import fast_matmul
from torchrl_gn.processor import product_speeds
from torchrl_gn.scenes import Scene, load_scene
from torchrl_gn.scenes.systems import find_system
from torchrl_gn.training import RunFolder, load_pretrained

WAYS = ("reference", "specialised", "bfloat16")


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


def thread_counts(threads: object) -> list[int]:
    """Return the numbers of threads, each once.

    Raises:
        ValueError: if there is none, or one is not 1 or more.
    """
    counts = list(dict.fromkeys(as_list(threads)))
    if not counts:
        raise ValueError("threads=[] must be one number or several.")
    for count in counts:
        check_options({"threads": count})
    return counts


def trained(cfg: DictConfig, run: RunFolder) -> list[str]:
    """Return run folders, files or names of the models to measure; train missing ones."""
    if cfg.checkpoints:
        return list(cfg.checkpoints)
    variants = {f"gn_{size}": [f"model.hidden={size}"] for size in cfg.sizes}
    for hidden in cfg.mlps:
        variants[f"mlp_{len(hidden)}x{hidden[0]}"] = ["model.core=mlp", f"model.hidden={list(hidden)}"]
    shared = [f"system={cfg.system}", f"data.folder={run.data}", f"seed={cfg.seed}"]
    shared += ["steps=null", f"minutes={cfg.minutes}", "clock=processor", *cfg.training]
    runs = [Run(FORWARD_MODEL, run.path / "models" / name, (*shared, *sizes), name) for name, sizes in variants.items()]
    refuse_failures(run_all(runs, 1))
    return [str(each.folder) for each in runs]


def title(model: ForwardModel) -> tuple[str, str]:
    """Return kind and size of a model."""
    kind = "MLP" if model.core_name == "mlp" else "GN"
    first = next(module for module in model.core.modules() if isinstance(module, MLP))
    widths = [layer.out_features for layer in first if isinstance(layer, nn.Linear)]
    return kind, f"{kind} {len(widths) - 1} x {widths[0]}"


def predict(model: Predictor, fast: bool, physics: Tensor, state: Tensor, actions: Tensor) -> Tensor:
    """Return the states that the model predicts."""
    with torch.no_grad(), fast_matmul() if fast else contextlib.nullcontext():
        return model.rollout(state, actions)[0]


def learned(checkpoints: list[str], scene: Scene, wanted: Sequence[str]) -> list[Method]:
    """Return a method for every trained model and wanted kind of evaluation that this processor is fast at."""
    methods = []
    for checkpoint in checkpoints:
        model = load_pretrained(checkpoint).model.requires_grad_(False)
        bound, (kind, name) = model.bind(scene), title(model)
        if any(other.name.startswith(f"{name},") for other in methods):
            name = f"{name} ({Path(checkpoint).name})"
        ways = {"reference": (model.bind(scene, reference=True), False), "specialised": (specialize(bound), True)}
        if product_speeds().pays(torch.bfloat16):
            ways["bfloat16"] = (specialize(bound, dtype=torch.bfloat16), True)
        for way, (module, fast) in ((way, ways[way]) for way in wanted if way in ways):
            methods.append(Method(f"{name}, {way}", f"{kind}, {way}", partial(predict, module, fast)))
    return methods


def variant(scene: Scene, substeps: int, iterations: int | None = None) -> Scene:
    """Return the scene with another physics step, and optionally another number of solver iterations."""
    system = find_system(scene.name)
    if system is None:
        raise ValueError(f"system={scene.name!r} is not one of the built-in systems, whose settings can be varied.")
    spec = system.build()
    spec.option.timestep = scene.timestep / substeps
    other = load_scene(spec, timestep=scene.timestep, name=scene.name)
    if iterations is not None:
        other.model.opt.iterations = iterations  # set last: load_scene raises it to MuJoCo's default
    return other


def simulate(simulators: dict[int, Simulator], physics: Tensor, _: Tensor, actions: Tensor) -> Tensor:
    """Return the states of the simulator that has as many threads as torch."""
    return simulators[torch.get_num_threads()].rollout(physics, actions)["state"]


def physical(cfg: DictConfig, scene: Scene, counts: Sequence[int]) -> list[Method]:
    """Return methods for MuJoCo at its own and at coarser time steps and solver settings, on torch's threads."""
    own, methods = scene.substeps, []
    settings = {substeps: None for substeps in cfg.substeps if substeps < own} | {own: None}
    for substeps, iterations in [*settings.items(), (own, 1)]:
        coarse = variant(scene, substeps, iterations)
        mujoco = {count: Simulator(coarse, num_threads=count) for count in counts}
        name = f"MuJoCo, {substeps} physics steps" + (", 1 solver iteration" if iterations else "")
        methods.append(Method(name, "MuJoCo", partial(simulate, mujoco)))
    return methods


def relative_error(prediction: Tensor, truth: Tensor, scene: Scene) -> float:
    """Return the mean over components of the squared error over the persistence baseline's; infinite if diverged."""
    nodes = torch.as_tensor(scene.predicted)
    prediction, truth = prediction[:, 1:, nodes], truth[:, :, nodes]
    if not bool(torch.isfinite(prediction).all()):
        return math.inf
    errors = squared_errors(prediction, truth[:, 1:]).flatten(0, -2).mean(0)
    baseline = squared_errors(truth[:, :1].expand_as(prediction), truth[:, 1:]).flatten(0, -2).mean(0)
    moves = baseline > 1e-24
    return float((errors[moves] / baseline[moves]).mean())


def on_threads(count: int, method: Method, *arguments: Tensor) -> Tensor:
    """Run a method on ``count`` threads; the native executor takes torch's number."""
    torch.set_num_threads(count)
    return method.run(*arguments)


def measure(
    cfg: DictConfig, scene: Scene, methods: list[Method], counts: list[int], data: tuple[Tensor, Tensor, Tensor]
) -> None:
    """Measure every method's median wall seconds per simulated second, by number of threads and batch size."""
    physics, state, actions = data
    for batch in cfg.batches:
        steps = max(1, min(actions.shape[1], cfg.state_steps // batch))
        rows = torch.arange(batch) % len(physics)
        arguments = physics[rows], state[rows], actions[rows, :steps]
        pairs = {f"{count} {method.name}": (count, method) for count in counts for method in methods}
        works = {name: partial(on_threads, count, method, *arguments) for name, (count, method) in pairs.items()}
        for name, values in time_in_turn(works, cfg.repeats, desc=f"timing, batch {batch}").items():
            count, method = pairs[name]
            method.seconds[count, batch] = statistics.median(values) / (batch * steps * scene.timestep)


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
        suffix = f", {threads}" if len(counts) > 1 else ""
        panels: dict[str, dict[str, tuple[list[float], list[float]]]] = {}
        print(f"{threads:38}{'error':>10}" + "".join(f"{f'batch {batch}':>14}" for batch in batches))
        fronts = {batch: pareto({m.name: (m.seconds[count, batch], m.error) for m in methods}) for batch in batches}
        for method in methods:
            cells = ""
            for batch in batches:
                seconds = method.seconds[count, batch]
                cells += f"{seconds:13.2e}{'*' if method.name in fronts[batch] else ' '}"
                metrics[f"{method.name}{suffix}/batch {batch}/seconds_per_simulated_second"] = seconds
                panel = panels.setdefault(f"s per simulated s, batch {batch}, {threads}", {})
                line = panel.setdefault(method.family, ([], []))
                line[0].append(seconds)
                line[1].append(method.error)
            print(f"{method.name:38}{method.error:10.1e}{cells}")
        figure = f"work_precision{suffix.replace(', ', '_').replace(' ', '_')}.png"
        plot_loglog(panels, run.file(figure), ylabel="error over equal simulated time")
    return metrics


def pareto(points: dict[str, tuple[float, float]]) -> set[str]:
    """Return the names of the Pareto-optimal points, where smaller is better in both coordinates."""
    return {
        name
        for name, (x, y) in points.items()
        if math.isfinite(y) and not any(a <= x and b <= y and (a, b) != (x, y) for a, b in points.values())
    }


@with_help
@hydra.main(config_path="config", config_name="work_precision", version_base="1.3")
@clean_exit
def main(cfg: DictConfig) -> None:
    counts = thread_counts(cfg.threads)
    if unknown := [way for way in cfg.ways if way not in WAYS]:
        raise ValueError(f"ways={unknown} are not known; use any of {list(WAYS)}.")
    scene = load_scene(cfg.system)
    if cfg.checkpoints:
        idle = ("minutes", "sizes", "mlps", "training")
        refuse_without_effect(cfg, Path(__file__), idle, because=f"checkpoints={list(cfg.checkpoints)}")
    run, tracker = open_run(cfg, "benchmarks/work_precision")
    methods = [*physical(cfg, scene, counts), *learned(trained(cfg, run), scene, cfg.ways)]

    rng = np.random.default_rng(cfg.seed)
    physics = torch.as_tensor(sample_start_states(scene, cfg.rollouts, rng))
    actions = torch.as_tensor(spline_controls(scene, cfg.rollouts, cfg.steps, rng))
    truth = Simulator(variant(scene, cfg.refinement * scene.substeps)).rollout(physics, actions)["state"]
    data = physics, truth[:, 0], actions
    for method in tqdm(methods, desc="errors", leave=False):  # one number of threads: others differ by rounding
        method.error = relative_error(on_threads(counts[0], method, *data), truth, scene)
    measure(cfg, scene, methods, counts, data)

    print(
        f"{scene.name}: relative error over {cfg.steps * scene.timestep:g} s, and wall seconds for a simulated second"
        " by batch. Lower is better; *: on the Pareto front."
    )
    metrics = report(methods, counts, list(cfg.batches), run)
    finish_run(cfg, run, tracker, metrics)


if __name__ == "__main__":
    main()
