"""A pendulum, its simulated transitions, points that learn, and trainings that take milliseconds a step."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.data import collect_trajectories, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import Scene, load_scene
from torchrl_gn.training import Budget
from torchrl_gn.training.optimizers import make_optimizer
from torchrl_gn.training.trainer import Trainer

from ..learner import make_learner as make_learner
from ..learner import point_env as point_env
from ..sizes import SMALL


@pytest.fixture(scope="session")
def scene() -> Scene:
    return load_scene("pendulum")


@pytest.fixture(scope="session")
def trajectories(scene) -> TensorDict:
    return collect_trajectories(scene, num=20, steps=20)


@pytest.fixture
def make_model(scene) -> Callable[..., ForwardModel]:
    def make(seed: int = 0, **options) -> ForwardModel:
        torch.manual_seed(seed)
        return ForwardModel.for_scene(scene, **(SMALL | {"latent": 4} | options))

    return make


@pytest.fixture
def make_trainer(scene, trajectories, make_model) -> Callable[..., Trainer]:
    """Training from fixed seeds, by default of a new model."""

    def make(
        budget: Budget,
        model: ForwardModel | None = None,
        *,
        preset="muon",
        noise: float = 0.01,
        unroll=0.0,
        device="cpu",
        **options,
    ) -> Trainer:
        fresh = model is None
        model = (make_model() if model is None else model).to(device)
        loss = ForwardModelLoss(model.bind(scene), noise=noise, generator=torch.Generator().manual_seed(0)).to(device)
        if fresh:
            loss.fit_normalizers(trajectory_buffer(trajectories, batch_size=500, seed=1).sample().to(device))
        if unroll:
            options |= {"unroll": trajectory_buffer(trajectories, batch_size=8, window=3, seed=2)}
            options |= {"unroll_fraction": unroll}
        buffer = trajectory_buffer(trajectories, batch_size=32, seed=0)
        return Trainer(loss, buffer, make_optimizer(model, preset), budget, **options)

    return make
