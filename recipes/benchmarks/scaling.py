"""Measure how much faster several processes train a forward model than one.

    python recipes/benchmarks/scaling.py [processes=[1,2]] [batches=[200,2000]] [key=value ...]

Times training steps of one process, of two and so on, in turn, for every batch size; torchrun and
DistributedDataParallel split the batch. Prints milliseconds a step, the speed-up, and the time of every part of a step:
the processes share sampling and model, and each repeats the optimiser. No figure of the paper. Results:
docs/results/scaling.md.

Writes config.yaml and metrics.json to its run folder.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import hydra
import torch
from omegaconf import DictConfig
from tqdm import tqdm

sys.path.append(str(Path(__file__).parents[1]))  # where _common is

from _common import clean_exit, finish_run, open_run, with_help
from _common.parent import run_child
from torchrl_gn.data import collect_trajectories, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import Budget, Trainer, Workers, join_workers, make_optimizer

PART = "TORCHRL_GN_BENCHMARK"  # variable of the timed processes: the file for their times


def measure(cfg: DictConfig, batch: int, workers: Workers) -> dict[str, float]:
    """Return median milliseconds of a step, and mean milliseconds of its parts."""
    torch.manual_seed(cfg.seed)
    torch.set_num_threads(cfg.threads)
    scene = load_scene(cfg.system)
    trajectories = collect_trajectories(scene, cfg.trajectories, seed=cfg.seed)
    model = ForwardModel.for_scene(scene)
    loss = ForwardModelLoss(model.bind(scene))
    loss.fit_normalizers(trajectory_buffer(trajectories, batch_size=2000, seed=cfg.seed).sample())
    buffer = trajectory_buffer(trajectories, batch_size=batch, seed=cfg.seed, shard=workers.shard)
    optimizer = make_optimizer(model.core, cfg.optimizer)
    trainer = Trainer(loss, buffer, optimizer, Budget(steps=cfg.steps + cfg.warm_up), workers=workers)
    seconds: list[float] = []
    before: dict[str, float] = {}
    for progress in trainer.run():
        if progress.step == cfg.warm_up:
            before = dict(trainer.spent)
        seconds.append(progress.seconds)
    steps = [after - start for start, after in zip(seconds[cfg.warm_up :], seconds[cfg.warm_up + 1 :], strict=False)]
    parts = {part: 1e3 * (spent - before[part]) / cfg.steps for part, spent in trainer.spent.items()}
    return {"step": 1e3 * median(steps), **{part: parts[part] for part in ("sampling", "model", "optimizer")}}


def start(cfg: DictConfig, batch: int, processes: int) -> dict[str, float]:
    """Return the same times for several processes started by torchrun."""
    with TemporaryDirectory() as folder:
        place = Path(folder) / "times.json"
        command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes)]
        options = [f"{name}={cfg[name]}" for name in ("system", "steps", "warm_up", "trajectories", "threads", "seed")]
        options += [f"batches=[{batch}]", f"optimizer={cfg.optimizer}"]
        environment = os.environ | {PART: str(place), "OMP_NUM_THREADS": str(cfg.threads)}
        done = run_child([*command, __file__, *options], env=environment)
        if done.returncode:
            raise ValueError(f"{processes} processes failed:\n{done.stderr}")
        return json.loads(place.read_text())


@with_help
@hydra.main(version_base=None, config_path="config", config_name="scaling")
@clean_exit
def main(cfg: DictConfig) -> None:
    if PART in os.environ:
        with join_workers() as workers:
            times = measure(cfg, cfg.batches[0], workers)
            if workers.first:
                Path(os.environ[PART]).write_text(json.dumps(times))
        return
    for name in ("steps", "warm_up"):
        if cfg[name] < 1:
            raise ValueError(f"{name}={cfg[name]} must be 1 or more.")
    run, tracker = open_run(cfg, "benchmarks/scaling")
    every = [(batch, processes) for batch in cfg.batches for processes in cfg.processes] * cfg.repeats
    found: dict[tuple[int, int], list[dict[str, float]]] = {}
    for batch, processes in tqdm(every, desc="measuring", leave=False):
        found.setdefault((batch, processes), []).append(start(cfg, batch, processes))
    metrics: dict[str, float] = {}
    print("Milliseconds of a training step and of its parts, medians: lower is better. Speed-up: over the first row.")
    print(
        f"{'batch':>8}{'processes':>11}{'ms a step':>11}{'speed-up':>10}{'sampling':>10}{'model':>10}{'optimizer':>11}"
    )
    for (batch, processes), times in found.items():
        middle = {part: median(each[part] for each in times) for part in times[0]}
        speedup = median(each["step"] for each in found[batch, cfg.processes[0]]) / middle["step"]
        metrics |= {f"batch {batch}/{processes} processes/{part}": value for part, value in middle.items()}
        metrics[f"batch {batch}/{processes} processes/speedup"] = speedup
        parts = f"{middle['sampling']:>10.1f}{middle['model']:>10.1f}{middle['optimizer']:>11.1f}"
        print(f"{batch:>8}{processes:>11}{middle['step']:>11.1f}{speedup:>9.2f}x{parts}")
    finish_run(cfg, run, tracker, metrics)


if __name__ == "__main__":
    main()
