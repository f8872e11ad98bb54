"""Run time against error of learned models and of MuJoCo itself, for one system.

    python recipes/benchmark.py [system=swimmer6] [minutes=4] [sizes=[64,128,256]] [mlps=[[512,512,512]]]

Every contestant predicts the same rollouts (starts and random controls of the dataset's kind) and is compared with
a finely stepped MuJoCo: GN forward models of several sizes and MLPs, trained here for `minutes` each (or
`checkpoints=[FOLDER,...]`), evaluated plain, specialised (with `fast_matmul`) and, where this processor is fast at
it, in bfloat16; and MuJoCo at its own and at coarser time steps and solver settings. Errors are relative to the
persistence baseline, over equal simulated time. Run time is wall time per simulated second of one trajectory, on
`threads` threads, at every batch size: medians, all contestants in turn.
A contestant is on the Pareto front of a batch size if nothing is both faster and more accurate.

Writes config.yaml, metrics.json, the figure work_precision.png and the trained models to its run folder; the same
run_dir goes on where it was interrupted. Results, and when a learned model is the right choice: docs/performance.md.
"""

from __future__ import annotations

import contextlib
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor
from tqdm import tqdm

from torchrl_gn.data import Simulator, sample_start_states, spline_controls
from torchrl_gn.dynamics import specialize
from torchrl_gn.evaluation import plot_loglog, squared_errors
from torchrl_gn.maths import fast_matmul
from torchrl_gn.processor import product_speeds
from torchrl_gn.scenes import Scene, load_scene
from torchrl_gn.scenes.systems import find_system
from torchrl_gn.training import RunFolder, Tracker, clean_exit, load_checkpoint, with_help
from torchrl_gn.training.sweep import Run, refuse_failures, run_all

RECIPE = Path(__file__).with_name("forward_model.py")


@dataclass
class Contestant:
    """Something that predicts states ``[B, T + 1, N, 13]`` from physics states ``[B, S]``, states and controls."""

    name: str
    family: str
    run: Callable[[Tensor, Tensor, Tensor], Tensor]
    error: float = math.nan
    seconds: dict[int, list[float]] = field(default_factory=dict)


def trained(cfg: DictConfig, run: RunFolder) -> list[Path]:
    """Run folders of the models to measure, training those that are not there."""
    if cfg.checkpoints:
        return [Path(folder) for folder in cfg.checkpoints]
    variants = {}
    for size in cfg.sizes:
        sizes = [f"model.{part}_hidden=[{size},{size}]" for part in ("edge", "node", "global")]
        variants[f"gn_{size}"] = [f"model.latent={size}", *sizes]
    for hidden in cfg.mlps:
        variants[f"mlp_{len(hidden)}x{hidden[0]}"] = ["model.core=mlp", f"model.mlp_hidden={list(hidden)}"]
    shared = [f"system={cfg.system}", f"data.folder={run.data}", f"seed={cfg.seed}", f"threads={cfg.threads}"]
    shared += ["steps=null", f"minutes={cfg.minutes}", "clock=processor", *cfg.training]
    runs = [Run(RECIPE, run.path / "models" / name, (*shared, *sizes), name) for name, sizes in variants.items()]
    refuse_failures(run_all(runs, 1))
    return [each.folder for each in runs]


def title(options: dict[str, Any]) -> tuple[str, str]:
    """Kind and size of a model."""
    if options["core"] == "mlp":
        return "MLP", f"MLP {len(options['mlp_hidden'])} x {options['mlp_hidden'][0]}"
    return "GN", f"GN {len(options['edge_hidden'])} x {options['edge_hidden'][0]}"


def learned(folders: list[Path], scene: Scene) -> list[Contestant]:
    """Contestants of every trained model."""
    contestants = []
    for folder in folders:
        model = load_checkpoint(folder).model.requires_grad_(False)
        bound, (kind, name) = model.bind(scene), title(model.options)
        if any(other.name.startswith(f"{name},") for other in contestants):
            name = f"{name} ({folder.name})"
        ways = {
            "plain": (model.bind(scene, plain=True), False),
            "specialised": (specialize(bound), True),
        }
        if product_speeds().pays(torch.bfloat16):
            ways["bfloat16"] = (specialize(bound, dtype=torch.bfloat16), True)
        for way, (module, fast) in ways.items():

            def rollout(physics: Tensor, state: Tensor, actions: Tensor, module=module, fast=fast) -> Tensor:
                with torch.no_grad(), fast_matmul() if fast else contextlib.nullcontext():
                    return module.rollout(state, actions)

            contestants.append(Contestant(f"{name}, {way}", f"{kind}, {way}", rollout))
    return contestants


def variant(scene: Scene, substeps: int, iterations: int | None = None) -> Scene:
    """The scene with another physics step, and fewer solver iterations."""
    system = find_system(scene.name)
    if system is None:
        raise ValueError(
            f"system={scene.name!r} is not one of the built-in systems, whose settings can be varied here."
        )
    spec = system.build()
    spec.option.timestep = scene.timestep / substeps
    if iterations is not None:
        spec.option.iterations = iterations
    return load_scene(spec, timestep=scene.timestep, name=scene.name)


def physical(cfg: DictConfig, scene: Scene) -> list[Contestant]:
    """MuJoCo at its own and at coarser time steps and solver settings."""
    own = scene.substeps
    settings = {substeps: None for substeps in cfg.substeps if substeps < own} | {own: None}
    contestants = []
    for substeps, iterations in [*settings.items(), (own, 1)]:
        simulator = Simulator(variant(scene, substeps, iterations), num_threads=cfg.threads)

        def rollout(physics: Tensor, state: Tensor, actions: Tensor, simulator=simulator) -> Tensor:
            return simulator.rollout(physics, actions)["state"]

        name = f"MuJoCo, {substeps} physics steps" + (", 1 solver iteration" if iterations else "")
        contestants.append(Contestant(name, "MuJoCo", rollout))
    return contestants


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


def measure(cfg: DictConfig, scene: Scene, contestants: list[Contestant], data: tuple[Tensor, Tensor, Tensor]) -> None:
    """Time every contestant in turn at every batch size."""
    physics, state, actions = data
    rounds = [(batch, turn) for batch in cfg.batches for turn in range(cfg.repeats + 1)]
    for batch, turn in tqdm(rounds, desc="timing", leave=False):
        steps = max(1, min(actions.shape[1], cfg.state_steps // batch))
        rows = torch.arange(batch) % len(physics)
        arguments = physics[rows], state[rows], actions[rows, :steps]
        for contestant in contestants:
            start = time.perf_counter()
            contestant.run(*arguments)
            seconds = (time.perf_counter() - start) / (batch * steps * scene.timestep)
            if turn > 0:
                contestant.seconds.setdefault(batch, []).append(seconds)


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
    run = RunFolder(cfg.run_dir, "benchmark")
    run.write_config(OmegaConf.to_yaml(cfg, resolve=True))
    tracker = Tracker(cfg.logger, run.path / "log", name="benchmark", config=cfg)
    contestants = [*physical(cfg, scene), *learned(trained(cfg, run), scene)]

    rng = np.random.default_rng(cfg.seed)
    physics = torch.as_tensor(sample_start_states(scene, cfg.rollouts, rng))
    actions = torch.as_tensor(spline_controls(scene, cfg.rollouts, cfg.steps, rng))
    fine = Simulator(variant(scene, cfg.refinement * scene.substeps))
    truth = fine.rollout(physics, actions)["state"]
    for contestant in tqdm(contestants, desc="errors", leave=False):
        contestant.error = relative_error(contestant.run(physics, truth[:, 0], actions), truth, scene)
    measure(cfg, scene, contestants, (physics, truth[:, 0], actions))

    metrics: dict[str, float | int] = {"threads": cfg.threads}
    panels: dict[str, dict[str, tuple[list[float], list[float]]]] = {}
    print(f"{scene.name}: error over {cfg.steps * scene.timestep:g} s; wall seconds per simulated second (*: Pareto)")
    print(f"{'':38}{'error':>10}" + "".join(f"{f'batch {batch}':>14}" for batch in cfg.batches))
    medians = {c.name: {batch: statistics.median(values) for batch, values in c.seconds.items()} for c in contestants}
    fronts = {batch: pareto({c.name: (medians[c.name][batch], c.error) for c in contestants}) for batch in cfg.batches}
    for contestant in contestants:
        cells = ""
        metrics[f"{contestant.name}/error"] = contestant.error
        for batch, seconds in medians[contestant.name].items():
            mark = "*" if contestant.name in fronts[batch] else " "
            cells += f"{seconds:13.2e}{mark}"
            metrics[f"{contestant.name}/batch {batch}/seconds_per_simulated_second"] = seconds
            line = panels.setdefault(f"s per simulated s, batch {batch}", {}).setdefault(contestant.family, ([], []))
            line[0].append(seconds)
            line[1].append(contestant.error)
        print(f"{contestant.name:38}{contestant.error:10.1e}{cells}")
    plot_loglog(panels, run.file("work_precision.png"), ylabel="error over equal simulated time")
    tracker.finish(run.write_metrics(metrics, seed=cfg.seed), run.written)
    for path in run.written:
        print(path)


if __name__ == "__main__":
    main()
