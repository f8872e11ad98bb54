"""A small training, run by torchrun from test_workers.py: writes the final weights of each process to a folder."""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import torch

from torchrl_gn.data import collect_trajectories, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import Budget, Trainer, Workers, join_workers, make_optimizer
from torchrl_gn.training.optimizers import Preset

PRESETS: tuple[Preset, ...] = ("adam", "muon")


def train(workers: Workers, preset: Preset, *, steps: int = 30) -> dict[str, torch.Tensor]:
    """Train on transitions and windows; return weights and statistics."""
    scene = load_scene("pendulum")
    trajectories = collect_trajectories(scene, num=20, steps=20)
    torch.manual_seed(workers.rank)  # the first one's weights are everybody's
    small = {"latent": 4, "edge_hidden": (8,), "node_hidden": (8,), "global_hidden": (8,)}
    model = ForwardModel.for_scene(scene, **small)
    loss = ForwardModelLoss(model.bind(scene))
    # ... and so are its statistics.
    loss.fit_normalizers(trajectory_buffer(trajectories, batch_size=500 + workers.rank, seed=workers.rank).sample())
    falling = itertools.chain([3.0, 2.0, 1.0], itertools.repeat(4.0))
    validate = (lambda: next(falling)) if workers.first else (lambda: -1.0)
    trainer = Trainer(
        loss,
        trajectory_buffer(trajectories, batch_size=16, seed=0, shard=workers.shard),
        make_optimizer(model.core, preset),
        Budget(steps=steps),
        unroll=trajectory_buffer(trajectories, batch_size=8, window=3, seed=1, shard=workers.shard),
        unroll_fraction=0.5,
        validate=validate,
        validations=10,
        patience=5,
        workers=workers,
    )
    losses = [progress.loss for progress in trainer.run()]
    numbers = {"losses": torch.tensor(losses), "best": torch.tensor(trainer.best)}
    return {**model.state_dict(), **numbers}


if __name__ == "__main__":
    with join_workers() as workers:
        results = {preset: train(workers, preset) for preset in PRESETS}
        torch.save(results, Path(sys.argv[1]) / f"{workers.rank}.pt")
