"""Workloads to time on a forward model: steps, rollouts, gradients and training steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import cast

import torch
from omegaconf import DictConfig
from tensordict import TensorDict
from torch import Tensor

from _speed.baselines import Baseline
from _speed.measure import Method, Workload
from torchrl_gn.dynamics import BoundPredictor, ForwardModel, Predictor
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.training import make_optimizer


def vjp(model: Predictor, state: Tensor, actions: Tensor) -> Tensor:
    """Return the gradient of a rollout with respect to its actions."""
    leaf = actions.clone().requires_grad_()
    model.rollout(state, leaf)[0][..., 7:].square().sum().backward()
    assert leaf.grad is not None
    return leaf.grad


def vjp_of_step(model: Predictor, state: Tensor, action: Tensor, gradient: Tensor) -> tuple[Tensor, ...]:
    """Return the gradients of state and action, given the gradient of the next state."""
    return torch.autograd.grad(model.step(state, action)[0], (state, action), gradient)


def make_workloads(
    cfg: DictConfig, model: ForwardModel, transitions: TensorDict, baselines: Mapping[str, Baseline]
) -> list[Workload]:
    """Return the workloads of the table, except the training step."""

    def first(batch: int, horizon: int = 1) -> tuple[Tensor, Tensor]:
        count = batch * horizon
        actions = cast(Tensor, transitions["action"]).repeat(-(-count // len(transitions)), 1)[:count]
        return cast(Tensor, transitions["state"])[:batch], actions.view(batch, horizon, -1)

    def others(kind: str, state: Tensor, actions: Tensor) -> dict[str, Callable[[], object]]:
        runs = {name: getattr(baseline, kind)(state, actions) for name, baseline in baselines.items()}
        return {name: run for name, run in runs.items() if run is not None}

    def step(batch: int) -> Workload:
        state, actions = first(batch)
        action = actions[:, 0].contiguous()

        def run(method: Method) -> Tensor:
            return method.model.step(state, action)[0]

        return Workload(
            f"step, batch {batch}", run, 1, cfg.repeats, others("step", state, action), lambda after: after - state
        )

    def single_steps(batch: int, horizon: int) -> Workload:
        start, actions = first(batch, horizon)

        def run(method: Method) -> Tensor:
            state = start
            for action in each:
                state = method.model.step(state, action)[0]
            return state

        each = [action.contiguous() for action in actions.unbind(1)]
        name = f"{horizon} single steps, batch {batch}"
        return Workload(name, run, horizon, cfg.repeats, compared=lambda after: after - start)

    def rollout(batch: int, horizon: int) -> Workload:
        state, actions = first(batch, horizon)

        def run(method: Method) -> Tensor:
            return method.model.rollout(state, actions)[0]

        baselines = others("rollout", state, actions)
        name = f"rollout of {horizon}, batch {batch}"
        return Workload(name, run, horizon, cfg.repeats, baselines, lambda states: states[:, -1] - state)

    def step_gradient(batch: int) -> Workload:
        state, actions = first(batch)
        leaf, action = (tensor.clone().requires_grad_() for tensor in (state, actions[:, 0]))
        gradient = 2 * state * (torch.arange(state.shape[-1]) >= 7)

        def run(method: Method) -> tuple[Tensor, ...]:
            return vjp_of_step(method.model, leaf, action, gradient)

        def compared(gradients: Sequence[Tensor]) -> Tensor:
            return torch.cat([each.flatten() for each in gradients])

        baselines = others("gradient", state, actions[:, 0])
        return Workload(f"gradient of a step, batch {batch}", run, 1, cfg.repeats, baselines, compared)

    def gradient(batch: int, horizon: int) -> Workload:
        state, actions = first(batch, horizon)

        def run(method: Method) -> Tensor:
            return vjp(method.model, state, actions)

        return Workload(f"gradient of {horizon}, batch {batch}", run, horizon, cfg.repeats)

    return [
        *(step(batch) for batch in cfg.batches),
        *(make(batch, cfg.horizon) for batch in cfg.rollout_batches for make in (rollout, single_steps)),
        *(step_gradient(batch) for batch in cfg.step_gradient_batches),
        *(gradient(batch, cfg.gradient_horizon) for batch in cfg.gradient_batches),
    ]


def train_workload(cfg: DictConfig, model: ForwardModel, transitions: TensorDict) -> Workload:
    """Return the workload of a whole training step: loss, gradient and optimiser."""
    batch = transitions[: cfg.training_batch]
    optimizer = make_optimizer(model.core, cfg.optimizer)
    losses: dict[int, ForwardModelLoss] = {}

    def run(method: Method) -> None:
        loss = losses.setdefault(id(method), ForwardModelLoss(cast(BoundPredictor, method.model)))
        optimizer.zero_grad()
        loss(batch)["loss_forward_model"].backward()
        optimizer.step(0, 1.0)  # the schedule has ended: the weights stay as they are

    return Workload(f"training step, batch {cfg.training_batch}", run, repeats=cfg.repeats)
