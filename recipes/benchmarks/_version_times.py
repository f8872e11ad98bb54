"""Run times of one version, the torchrl_gn that Python finds, as a program of versions.py.

    PYTHONPATH=checkout:recipes/benchmarks python recipes/_common/parent.py _version_times options.json

It imports nothing of the recipes, which may belong to another version. The times overwrite options.json.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from typing import Any

import torch
from omegaconf import DictConfig

import torchrl_gn
from torchrl_gn import collect_trajectories, load_pretrained, specialize
from torchrl_gn.data import trajectory_buffer
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.training import make_optimizer


def works(cfg: DictConfig) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield name and call of each work, using only functions that all versions have."""
    model = load_pretrained(cfg.system)
    scene: Any = model.scene()
    bound = model.bind(scene)
    quick = specialize(bound)
    most = max(*cfg.batches, *cfg.rollout_batches, cfg.live_batch, cfg.training_batch)
    data = collect_trajectories(scene, most, steps=cfg.horizon + 1, seed=cfg.seed)
    states, actions = data["state"][:, 0].contiguous(), data["action"].contiguous()
    for batch in cfg.batches:
        inputs = states[:batch].clone(), actions[:batch, 0].clone()
        yield f"step, batch {batch}", lambda inputs=inputs: quick.step(*inputs)
    for batch in cfg.rollout_batches:
        inputs = states[:batch].clone(), actions[:batch, : cfg.horizon].clone()
        yield f"rollout of {cfg.horizon}, batch {batch}", lambda inputs=inputs: quick.rollout(*inputs)

        def vjp(inputs=inputs) -> None:
            leaf = inputs[1].detach().requires_grad_()
            quick.rollout(inputs[0], leaf)[0].sum().backward()

        yield f"gradient of {cfg.horizon}, batch {batch}", vjp
    inputs = states[: cfg.live_batch].clone(), actions[: cfg.live_batch, : cfg.live_horizon].clone()
    for name, predictor in (("specialised", quick), ("live", bound)):

        def roll(predictor=predictor) -> None:
            with torch.no_grad():
                predictor.rollout(*inputs)

        yield f"{name} rollout of {cfg.live_horizon}, batch {cfg.live_batch}", roll
    loss, optimizer = ForwardModelLoss(bound), make_optimizer(model.model.core)
    batch = trajectory_buffer(data, batch_size=cfg.training_batch, seed=cfg.seed).sample()

    def train() -> None:
        optimizer.zero_grad()
        loss(batch)["loss_forward_model"].backward()
        optimizer.step(0, 1.0)  # the schedule has ended: the weights stay as they are

    yield f"training step, batch {cfg.training_batch}", train


def measure(cfg: DictConfig) -> dict[str, float]:
    """Return the median milliseconds of a call of every work, in processor time."""
    torch.set_num_threads(cfg.threads)
    torch.manual_seed(cfg.seed)
    found = {}
    for name, run in works(cfg):
        run()
        run()
        seconds: list[float] = []
        while sum(seconds) < cfg.seconds:
            start = time.process_time()
            run()
            seconds.append(time.process_time() - start)
        found[name] = 1e3 * median(seconds)
    return found


if __name__ == "__main__":
    file = Path(sys.argv[1])
    times = measure(DictConfig(json.loads(file.read_text())))
    file.write_text(json.dumps({"library": torchrl_gn.__file__, "times": times}))
