"""Measure the run time of the forward model: specialised and reference, the same workload in turn.

    python recipes/benchmarks/speed.py [system=swimmer6] [hidden=[128,128]] [compile=true] [curves=true]
        [baselines=[jraph,mujoco]]

Times one step, rollouts, gradients through a step and through rollouts, and a training step of one forward model with
random weights and true physical parameters. Evaluates it as `reference` (PyG message passing, eager), `folded` (the
bound model, which trains natively), `specialised` (by torch operations), `native` and `compiled`; also with oneDNN's
matrix products in place of torch's (`fast`), and with bfloat16 products where this processor is fast at them. All run
in turn, several times; a short workload runs many times a turn. The table shows medians, speed-ups over `reference` and
jraph, peak memory, and errors against the reference in float64.

`baselines=[jraph,mujoco]` also times baselines in turn. `jraph` is the same network with the same weights, as jraph
users would write it, under `jax.jit` in float32. It times the network alone, from graph features to output nodes, which
are checked against ours, and the gradient from output nodes to node and edge features. Our times go from state to
state, with features and projection. With jraph, the process stays on as many cores as `threads`, and JAX computes in
the calling thread. `mujoco` is MuJoCo's C code on one thread. A baseline appears only in the rows of workloads that it
supports.

`own_parameters=true` gives each sample the physical parameters of its own variant, as in planning for identified
systems. It leaves out `folded`, training steps and curves, and takes no baselines.

`bound` is a lower bound on a step's time, as a share of the measured time. The bound is the larger of two times: the
network's FLOPs at the rate of a large matrix product, and one read of its weights at the bandwidth of repeated reads of
as many bytes. FLOPs and weights are the specialised network's. `curves=true` draws the time of a step over links, batch
sizes and hidden sizes, and of a rollout's gradient over its length. No figure of the paper. Takes about ten minutes,
half of it compiling. Results: docs/results/speed.md.

Writes config.yaml, metrics.json and with curves the figure speed.png to its run folder.
"""

from __future__ import annotations

import copy
import functools
import itertools
import os
import statistics
import sys
from pathlib import Path
from typing import Any, cast

import hydra
import numpy as np
import torch
from omegaconf import DictConfig
from tensordict import TensorDict
from tqdm import tqdm

sys.path.append(str(Path(__file__).parents[1]))  # where _common is

from _common import as_list, clean_exit, finish_run, open_run, with_help
from _speed.baselines import make_baselines
from _speed.measure import Method, measure, timed
from _speed.table import least_times, report
from _speed.workloads import make_workloads, train_workload, vjp
from torchrl_gn.data import collect_trajectories, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel, specialize
from torchrl_gn.dynamics.bound import update_parameter_normalizers
from torchrl_gn.dynamics.executors import EXECUTORS
from torchrl_gn.evaluation import plot_loglog
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.processor import product_speeds, usable_cores
from torchrl_gn.scenes import load_scene, sample_variants
from torchrl_gn.scenes.physical_parameters import PhysicalParameters

BATCHES = ("batches", "rollout_batches", "step_gradient_batches", "gradient_batches")


def make_model(cfg: DictConfig, system: str, hidden: list[int]) -> tuple[ForwardModel, TensorDict]:
    """Return a model with random weights and normalisers of a short collection, and the collected transitions."""
    scene = load_scene(system)
    trajectories = collect_trajectories(scene, 64, 64, cfg.seed)
    transitions = cast(TensorDict, trajectory_buffer(trajectories, batch_size=64 * 64, seed=cfg.seed).sample())
    torch.manual_seed(cfg.seed)
    edges = hidden if cfg.edge_hidden is None else list(cfg.edge_hidden)
    sizes = {"hidden": hidden, "edge_hidden": edges, "latent": cfg.latent}
    model = ForwardModel.for_scene(scene, activation=cfg.activation, **sizes)
    ForwardModelLoss(model.bind(scene)).fit_normalizers(transitions)
    return model, transitions


def variants_parameters(cfg: DictConfig, model: ForwardModel) -> TensorDict:
    """Return a variant's parameters for each sample of the largest batch; update the model's statistics with them.

    Raises:
        ValueError: with baselines, which have one system for all samples.
    """
    if as_list(cfg.baselines):
        raise ValueError("Baselines have one system for all samples: leave out baselines or own_parameters.")
    most = max(itertools.chain(*(cfg[name] for name in BATCHES)))
    bound = model.bind(load_scene(cfg.system), parameters_key="parameters")
    variants = sample_variants(cfg.system, most, np.random.default_rng(cfg.seed))
    every: Any = [PhysicalParameters.of(variant).tensordict() for variant in variants]
    parameters = cast(TensorDict, torch.stack(every))
    update_parameter_normalizers(bound, parameters)
    return parameters


def make_methods(cfg: DictConfig, model: ForwardModel, system: str, parameters: TensorDict | None) -> dict[str, Method]:
    """Return the predictors to time by name, the reference first; ``folded`` only without ``parameters`` of samples."""
    scene, key = load_scene(system), None if parameters is None else "parameters"
    bound, reference = model.bind(scene, parameters_key=key), model.bind(scene, reference=True, parameters_key=key)
    methods = {"reference": Method(reference), "reference, fast": Method(reference, fast=True)}
    if parameters is None:
        methods["folded, fast"] = Method(bound, fast=True)
    rounded = product_speeds().pays(torch.bfloat16)
    for executor in EXECUTORS:
        if executor == "compiled" and not cfg.compile:
            continue
        name = "specialised" if executor == "eager" else executor
        methods[name] = Method(specialize(bound, executor=executor))
        if executor in ("eager", "compiled"):  # these use torch's products
            methods[f"{name}, fast"] = Method(methods[name].model, fast=True)
            if rounded:
                methods[f"{name}, bfloat16"] = Method(specialize(bound, dtype=torch.bfloat16, executor=executor))
    return {name: method.with_parameters(parameters) for name, method in methods.items()}


def curves(cfg: DictConfig) -> dict[str, dict[str, tuple[list[float], list[float]]]]:
    """Measure milliseconds of a step over links, batch and hidden size, and of gradients over horizons."""
    panels: dict[str, dict[str, tuple[list[float], list[float]]]] = {}
    points = [("links, batch 100", f"swimmer{links}", 100, 128, links) for links in cfg.curve_links]
    points += [("batch", cfg.system, batch, 128, batch) for batch in cfg.curve_batches]
    points += [("hidden size, batch 100", cfg.system, 100, hidden, hidden) for hidden in cfg.curve_hidden]
    points += [("horizon, batch 100, with gradient", cfg.system, 100, 128, steps) for steps in cfg.curve_horizons]
    for panel, system, batch, hidden, x in tqdm(points, desc="curves", leave=False):
        model, transitions = make_model(cfg, system, [hidden, hidden])
        bound = model.bind(load_scene(system))
        methods = {
            "reference": Method(model.bind(bound.scene, reference=True)),
            "specialised": Method(specialize(bound)),
            "specialised, fast": Method(specialize(bound), fast=True),
        }
        model.requires_grad_(False)
        state, action = transitions["state"][:batch], transitions["action"][:batch]
        for name, method in methods.items():
            if panel.startswith("horizon"):
                run = functools.partial(vjp, method.model, state, action.unsqueeze(1).expand(-1, x, -1))
            else:
                run = functools.partial(method.model.step, state, action)
            seconds = [timed(run, method.fast)[1] for _ in range(max(4, cfg.repeats // 2))]
            line = panels.setdefault(panel, {}).setdefault(name, ([], []))
            line[0].append(x)
            line[1].append(1e3 * statistics.median(seconds[1:]))
    return panels


@with_help
@hydra.main(config_path="config", config_name="speed", version_base="1.3")
@clean_exit
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(cfg.threads)
    torch.manual_seed(cfg.seed)
    model, transitions = make_model(cfg, cfg.system, list(cfg.hidden))
    parameters = variants_parameters(cfg, model) if cfg.own_parameters else None
    baselines = make_baselines(cfg, model, load_scene(cfg.system), as_list(cfg.baselines))
    run, tracker = open_run(cfg, "benchmarks/speed")
    methods, workloads = (
        make_methods(cfg, model, cfg.system, parameters),
        make_workloads(cfg, model, transitions, baselines),
    )
    model.requires_grad_(False)
    bound = (
        copy.deepcopy(model)
        .double()
        .bind(load_scene(cfg.system), reference=True, parameters_key=methods["reference"].model.parameters_key)
    )
    compile_seconds = measure(workloads, methods, Method(bound).with_parameters(parameters))
    if parameters is None:
        model.requires_grad_(True)
        workloads.append(train_workload(cfg, model, transitions))
        measure(
            workloads[-1:],
            {name: method for name, method in methods.items() if "reference" in name or "folded" in name},
        )

    print(f"{methods['specialised'].model}")
    print(
        f"\nMilliseconds a step (lower is better), medians of {cfg.repeats}, threads: {cfg.threads}. /reference,"
        " /jraph: times as fast; bound: share of the least time that this machine allows; error: against the reference."
    )
    if "jraph" in baselines:
        print(f"This process on {usable_cores()} cores, XLA_FLAGS={os.environ.get('XLA_FLAGS', '')}")
    metrics = {"threads": cfg.threads, **report(workloads, least_times(cfg, workloads, methods))}
    metrics |= {f"first call/{name}": seconds for name, seconds in compile_seconds.items()}
    if compile_seconds:
        print(
            "First call of the compiled model, which compiles: "
            + ", ".join(f"{n} {s:.0f} s" for n, s in compile_seconds.items())
        )
    if cfg.curves and parameters is None:
        panels = curves(cfg)
        for panel, lines in panels.items():
            for name, (xs, ys) in lines.items():
                metrics.update({f"curve/{panel}/{name}/{x}": y for x, y in zip(xs, ys, strict=True)})
        plot_loglog(panels, run.file("speed.png"), ylabel="milliseconds")
    finish_run(cfg, run, tracker, metrics)


if __name__ == "__main__":
    main()
