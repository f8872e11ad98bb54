"""Run time against error of learned models and of MuJoCo itself, for one system.

    python recipes/benchmark.py [system=swimmer6] [minutes=4] [sizes=[64,128,256]] [mlps=[[512,512,512]]]

Measures, on the same rollouts (starts and random controls as in the data sets), GN forward models of several sizes and
MLPs, trained here for `minutes` each (or `checkpoints=[FOLDER,...]`) and evaluated by message passing (reference),
specialised and, where this processor is fast at it, in bfloat16; and MuJoCo at its own and at coarser settings.
Errors are against a finely stepped MuJoCo, relative to the persistence baseline, over equal simulated
time. Run time is wall time per simulated second of one trajectory, on `threads` threads, at every batch size: medians,
all methods in turn. A method is on the Pareto front of a batch size if no other is both faster and more accurate.

Writes config.yaml, metrics.json, the figure work_precision.png and the trained models to its run folder; the same
run_dir goes on where it was interrupted. Results: docs/results/run-time-against-error.md; when a learned model is the
right choice: docs/speed.md.
"""

from __future__ import annotations

import contextlib
import math
import statistics
from collections.abc import Callable
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

from _common import clean_exit, finish_run, open_run, with_help
from _common.sweeps import FORWARD_MODEL, Run, refuse_failures, run_all
from _common.timing import time_in_turn
from torchrl_gn.data import Simulator, sample_start_states, spline_controls
from torchrl_gn.dynamics import ForwardModel, Predictor, specialize
from torchrl_gn.evaluation import plot_loglog, squared_errors
from torchrl_gn.maths import fast_matmul
from torchrl_gn.processor import product_speeds
from torchrl_gn.scenes import Scene, load_scene
from torchrl_gn.scenes.systems import find_system
from torchrl_gn.training import RunFolder, load_pretrained


@dataclass
class Method:
    """A way to predict states ``[B, T + 1, N, 13]`` from physics states ``[B, S]``, states and controls."""

    name: str
    family: str
    run: Callable[[Tensor, Tensor, Tensor], Tensor]
    error: float = math.nan
    seconds: dict[int, float] = field(default_factory=dict)


def trained(cfg: DictConfig, run: RunFolder) -> list[str]:
    """Run folders, files or names of the models to measure, training those that are not there."""
    if cfg.checkpoints:
        return list(cfg.checkpoints)
    variants = {f"gn_{size}": [f"model.hidden={size}"] for size in cfg.sizes}
    for hidden in cfg.mlps:
        variants[f"mlp_{len(hidden)}x{hidden[0]}"] = ["model.core=mlp", f"model.hidden={list(hidden)}"]
    shared = [f"system={cfg.system}", f"data.folder={run.data}", f"seed={cfg.seed}", f"threads={cfg.threads}"]
    shared += ["steps=null", f"minutes={cfg.minutes}", "clock=processor", *cfg.training]
    runs = [Run(FORWARD_MODEL, run.path / "models" / name, (*shared, *sizes), name) for name, sizes in variants.items()]
    refuse_failures(run_all(runs, 1))
    return [str(each.folder) for each in runs]


def title(model: ForwardModel) -> tuple[str, str]:
    """Kind and size of a model."""
    kind = "MLP" if model.core_name == "mlp" else "GN"
    first = next(module for module in model.core.modules() if isinstance(module, MLP))
    widths = [layer.out_features for layer in first if isinstance(layer, nn.Linear)]
    return kind, f"{kind} {len(widths) - 1} x {widths[0]}"


def predict(model: Predictor, fast: bool, physics: Tensor, state: Tensor, actions: Tensor) -> Tensor:
    """States that the model predicts."""
    with torch.no_grad(), fast_matmul() if fast else contextlib.nullcontext():
        return model.rollout(state, actions)[0]


def learned(checkpoints: list[str], scene: Scene) -> list[Method]:
    """Every trained model, evaluated in every way."""
    methods = []
    for checkpoint in checkpoints:
        model = load_pretrained(checkpoint).model.requires_grad_(False)
        bound, (kind, name) = model.bind(scene), title(model)
        if any(other.name.startswith(f"{name},") for other in methods):
            name = f"{name} ({Path(checkpoint).name})"
        ways = {"reference": (model.bind(scene, reference=True), False), "specialised": (specialize(bound), True)}
        if product_speeds().pays(torch.bfloat16):
            ways["bfloat16"] = (specialize(bound, dtype=torch.bfloat16), True)
        for way, (module, fast) in ways.items():
            methods.append(Method(f"{name}, {way}", f"{kind}, {way}", partial(predict, module, fast)))
    return methods


def variant(scene: Scene, substeps: int, iterations: int | None = None) -> Scene:
    """The scene with another physics step, and fewer solver iterations."""
    system = find_system(scene.name)
    if system is None:
        raise ValueError(f"system={scene.name!r} is not one of the built-in systems, whose settings can be varied.")
    spec = system.build()
    spec.option.timestep = scene.timestep / substeps
    if iterations is not None:
        spec.option.iterations = iterations
    return load_scene(spec, timestep=scene.timestep, name=scene.name)


def physical(cfg: DictConfig, scene: Scene) -> list[Method]:
    """MuJoCo at its own and at coarser time steps and solver settings."""
    own, methods = scene.substeps, []
    settings = {substeps: None for substeps in cfg.substeps if substeps < own} | {own: None}
    for substeps, iterations in [*settings.items(), (own, 1)]:
        mujoco = Simulator(variant(scene, substeps, iterations), num_threads=cfg.threads)
        name = f"MuJoCo, {substeps} physics steps" + (", 1 solver iteration" if iterations else "")
        methods.append(Method(name, "MuJoCo", lambda start, _, actions, of=mujoco: of.rollout(start, actions)["state"]))
    return methods


def relative_error(prediction: Tensor, truth: Tensor, scene: Scene) -> float:
    """Mean over components of squared error by that of the persistence baseline; infinite if it diverged."""
    nodes = torch.as_tensor(scene.predicted)
    prediction, truth = prediction[:, 1:, nodes], truth[:, :, nodes]
    if not bool(torch.isfinite(prediction).all()):
        return math.inf
    errors = squared_errors(prediction, truth[:, 1:]).flatten(0, -2).mean(0)
    baseline = squared_errors(truth[:, :1].expand_as(prediction), truth[:, 1:]).flatten(0, -2).mean(0)
    moves = baseline > 1e-24
    return float((errors[moves] / baseline[moves]).mean())


def measure(cfg: DictConfig, scene: Scene, methods: list[Method], data: tuple[Tensor, Tensor, Tensor]) -> None:
    """Median wall seconds per simulated second of every method at every batch size."""
    physics, state, actions = data
    for batch in cfg.batches:
        steps = max(1, min(actions.shape[1], cfg.state_steps // batch))
        rows = torch.arange(batch) % len(physics)
        arguments = physics[rows], state[rows], actions[rows, :steps]
        works = {str(index): partial(method.run, *arguments) for index, method in enumerate(methods)}
        seconds = time_in_turn(works, cfg.repeats, desc=f"timing, batch {batch}")
        for method, values in zip(methods, seconds.values(), strict=True):
            method.seconds[batch] = statistics.median(values) / (batch * steps * scene.timestep)


def pareto(points: dict[str, tuple[float, float]]) -> set[str]:
    """Names of the points that no other beats in both coordinates."""
    return {
        name
        for name, (x, y) in points.items()
        if math.isfinite(y) and not any(a <= x and b <= y and (a, b) != (x, y) for a, b in points.values())
    }


@with_help
@hydra.main(config_path="config", config_name="benchmark", version_base="1.3")
@clean_exit
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(cfg.threads)
    scene = load_scene(cfg.system)
    run, tracker = open_run(cfg, "benchmark")
    methods = [*physical(cfg, scene), *learned(trained(cfg, run), scene)]

    rng = np.random.default_rng(cfg.seed)
    physics = torch.as_tensor(sample_start_states(scene, cfg.rollouts, rng))
    actions = torch.as_tensor(spline_controls(scene, cfg.rollouts, cfg.steps, rng))
    truth = Simulator(variant(scene, cfg.refinement * scene.substeps)).rollout(physics, actions)["state"]
    for method in tqdm(methods, desc="errors", leave=False):
        method.error = relative_error(method.run(physics, truth[:, 0], actions), truth, scene)
    measure(cfg, scene, methods, (physics, truth[:, 0], actions))

    metrics: dict[str, float | int] = {"threads": cfg.threads}
    panels: dict[str, dict[str, tuple[list[float], list[float]]]] = {}
    print(f"{scene.name}: error over {cfg.steps * scene.timestep:g} s; wall seconds per simulated second (*: Pareto)")
    print(f"{'':38}{'error':>10}" + "".join(f"{f'batch {batch}':>14}" for batch in cfg.batches))
    fronts = {batch: pareto({m.name: (m.seconds[batch], m.error) for m in methods}) for batch in cfg.batches}
    for method in methods:
        cells = ""
        metrics[f"{method.name}/error"] = method.error
        for batch, seconds in method.seconds.items():
            mark = "*" if method.name in fronts[batch] else " "
            cells += f"{seconds:13.2e}{mark}"
            metrics[f"{method.name}/batch {batch}/seconds_per_simulated_second"] = seconds
            line = panels.setdefault(f"s per simulated s, batch {batch}", {}).setdefault(method.family, ([], []))
            line[0].append(seconds)
            line[1].append(method.error)
        print(f"{method.name:38}{method.error:10.1e}{cells}")
    plot_loglog(panels, run.file("work_precision.png"), ylabel="error over equal simulated time")
    finish_run(cfg, run, tracker, metrics)


if __name__ == "__main__":
    main()
