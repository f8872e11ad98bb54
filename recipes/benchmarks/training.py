"""Measure the run time of a training step: sampling, loss, gradient and optimiser, with several optimisers in turn.

    python recipes/benchmarks/training.py [system=swimmer6] [optimizers=[muon,torch_muon,adam]] [threads=1]

Trains one forward model of default size for each optimiser, a step each in turn, and prints the median time of every
part. `torch_muon` is `torch.optim.Muon`, which multiplies in bfloat16 and is slow on processors without instructions
for it. No figure of the paper. Takes a minute, or several on such processors. Results: docs/results/training-speed.md.

Writes config.yaml and metrics.json to its run folder.
"""

from __future__ import annotations

import copy
import statistics
import sys
import time
from collections import defaultdict
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig
from torch import nn
from tqdm import trange

sys.path.append(str(Path(__file__).parents[1]))  # where _common is

from _common import as_list, clean_exit, finish_run, open_run, with_help
from torchrl_gn.data import collect_trajectories, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.maths import fast_matmul
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.processor import threads_for_native
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import ScheduledOptimizer, make_optimizer

PARTS = ("sampling", "loss", "gradient", "optimiser")


def optimizer_of(module: nn.Module, name: str) -> ScheduledOptimizer:
    """Return a preset, or for ``"torch_muon"`` the default preset with torch's Muon in place of ours."""
    if name != "torch_muon":
        return make_optimizer(module, name)  # type: ignore[arg-type]
    theirs = make_optimizer(module)
    matrices = [parameter for parameter in module.parameters() if parameter.ndim == 2]
    optimizers = [torch.optim.Muon(matrices, lr=1e-2, weight_decay=0.0), *theirs.optimizers[1:]]
    return ScheduledOptimizer(optimizers, theirs.schedule)


def measure(cfg: DictConfig) -> dict[str, dict[str, float]]:
    """Return median milliseconds of every part by optimiser."""
    scene = load_scene(cfg.system)
    trajectories = collect_trajectories(scene, cfg.trajectories, 100, cfg.seed)
    fresh = ForwardModel.for_scene(scene)
    ForwardModelLoss(fresh.bind(scene)).fit_normalizers(trajectory_buffer(trajectories, batch_size=5000).sample())
    models = {name: copy.deepcopy(fresh) for name in as_list(cfg.optimizers)}
    losses = {name: ForwardModelLoss(model.bind(scene)) for name, model in models.items()}
    optimizers = {name: optimizer_of(model.core, name) for name, model in models.items()}
    buffer = trajectory_buffer(trajectories, batch_size=cfg.batch_size, seed=cfg.seed)
    seconds: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    with fast_matmul(), threads_for_native():
        for step in trange(cfg.steps + cfg.warm_up, desc="training", leave=False):
            for name, loss in losses.items():
                times = [time.perf_counter()]
                batch = buffer.sample()
                times.append(time.perf_counter())
                value = loss(batch)["loss_forward_model"]
                times.append(time.perf_counter())
                optimizers[name].zero_grad()
                value.backward()
                times.append(time.perf_counter())
                optimizers[name].step(step, 0.5)
                times.append(time.perf_counter())
                for part, start, end in zip(PARTS, times[:-1], times[1:], strict=True):
                    seconds[name][part].append(end - start)
    return {
        name: {part: 1e3 * statistics.median(taken[cfg.warm_up :]) for part, taken in parts.items()}
        for name, parts in seconds.items()
    }


@with_help
@hydra.main(config_path="config", config_name="training", version_base="1.3")
@clean_exit
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(cfg.threads)
    torch.manual_seed(cfg.seed)
    run, tracker = open_run(cfg, "benchmarks/training")
    found = measure(cfg)
    metrics: dict[str, float] = {"threads": cfg.threads}
    print("Milliseconds of a training step by part: lower is better. Its share: the optimiser's.")
    print(f"{'optimiser':12}" + "".join(f"{title:>12}" for title in (*PARTS, "in all", "its share")))
    for name, parts in found.items():
        whole = sum(parts.values())
        share = parts["optimiser"] / whole
        print(f"{name:12}" + "".join(f"{parts[part]:12.2f}" for part in PARTS) + f"{whole:12.2f}{100 * share:10.0f} %")
        metrics |= {f"{name}/{part}": value for part, value in parts.items()} | {f"{name}/optimiser_share": share}
    finish_run(cfg, run, tracker, metrics)


if __name__ == "__main__":
    main()
