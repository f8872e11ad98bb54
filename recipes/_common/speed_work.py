"""Work to time on a forward model: steps, rollouts, gradients and training steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import cast

import torch
from omegaconf import DictConfig
from tensordict import TensorDict
from torch import Tensor

from _common.speed_baselines import Baseline
from _common.speed_measure import Way, Work
from torchrl_gn.dynamics import ForwardModel, Predictor
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.training import make_optimizer


@torch.no_grad()
def step_once(model: Predictor, state: Tensor, action: Tensor) -> Tensor:
    """Next state."""
    return model.step(state, action)[0]


def pull(model: Predictor, state: Tensor, actions: Tensor) -> Tensor:
    """Gradient of a rollout to its actions."""
    leaf = actions.clone().requires_grad_()
    model.rollout(state, leaf)[0][..., 7:].square().sum().backward()
    assert leaf.grad is not None
    return leaf.grad


def pull_once(model: Predictor, state: Tensor, action: Tensor) -> Tensor:
    """Gradient of a scalar of the next state to state and action, in one row."""
    state, action = (tensor.clone().requires_grad_() for tensor in (state, action))
    loss = model.step(state, action)[0][..., 7:].square().sum()
    return torch.cat([gradient.flatten() for gradient in torch.autograd.grad(loss, (state, action))])


def make_works(
    cfg: DictConfig, model: ForwardModel, transitions: TensorDict, baselines: Mapping[str, Baseline]
) -> list[Work]:
    """The work of the table, but for the training step."""

    def first(batch: int, horizon: int = 1) -> tuple[Tensor, Tensor]:
        count = batch * horizon
        actions = cast(Tensor, transitions["action"]).repeat(-(-count // len(transitions)), 1)[:count]
        return cast(Tensor, transitions["state"])[:batch], actions.view(batch, horizon, -1)

    def others(kind: str, state: Tensor, actions: Tensor) -> dict[str, Callable[[], object]]:
        runs = {name: getattr(baseline, kind)(state, actions) for name, baseline in baselines.items()}
        return {name: run for name, run in runs.items() if run is not None}

    def step(batch: int) -> Work:
        state, actions = first(batch)

        def run(way: Way) -> Tensor:
            return step_once(way.model, state, actions[:, 0]) - state

        return Work(f"step, batch {batch}", run, 1, cfg.repeats, others("step", state, actions[:, 0]))

    def single_steps(batch: int, horizon: int) -> Work:
        start, actions = first(batch, horizon)

        def run(way: Way) -> Tensor:
            state = start
            for action in actions.unbind(1):
                state = step_once(way.model, state, action)
            return state - start

        return Work(f"{horizon} single steps, batch {batch}", run, horizon, cfg.repeats)

    def rollout(batch: int, horizon: int) -> Work:
        state, actions = first(batch, horizon)

        def run(way: Way) -> Tensor:
            with torch.no_grad():
                return way.model.rollout(state, actions)[0][:, -1] - state

        return Work(
            f"rollout of {horizon}, batch {batch}", run, horizon, cfg.repeats, others("rollout", state, actions)
        )

    def step_gradient(batch: int) -> Work:
        state, actions = first(batch)

        def run(way: Way) -> Tensor:
            return pull_once(way.model, state, actions[:, 0])

        return Work(f"gradient of a step, batch {batch}", run, 1, cfg.repeats, others("gradient", state, actions[:, 0]))

    def gradient(batch: int, horizon: int) -> Work:
        state, actions = first(batch, horizon)

        def run(way: Way) -> Tensor:
            return pull(way.model, state, actions)

        return Work(f"gradient of {horizon}, batch {batch}", run, horizon, cfg.repeats)

    return [
        *(step(batch) for batch in cfg.batches),
        *(make(batch, cfg.horizon) for batch in cfg.rollout_batches for make in (rollout, single_steps)),
        *(step_gradient(batch) for batch in cfg.step_gradient_batches),
        *(gradient(batch, cfg.gradient_horizon) for batch in cfg.gradient_batches),
    ]


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
