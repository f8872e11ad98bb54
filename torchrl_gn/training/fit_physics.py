"""Fitting of known physics' parameters to trajectories."""

from __future__ import annotations

from typing import cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_gn.checks import check_counts
from torchrl_gn.data import trajectory_buffer
from torchrl_gn.dynamics.features.controls import ControlInputs
from torchrl_gn.evaluation.errors import squared_errors
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.scenes import Articulation
from torchrl_gn.scenes.checked_trajectories import check_trajectories
from torchrl_gn.training.gradients import with_gradients
from torchrl_gn.training.optimizers import clip_gradients


@without_autocast
@with_gradients
def fit_physics(
    physics: nn.Module,
    scene: Articulation,
    trajectories: TensorDictBase,
    *,
    steps: int = 300,
    window: int = 20,
    batch_size: int = 128,
    lr: float = 2e-2,
    seed: int = 0,
) -> list[float]:
    """Fit the parameters of physics that require gradients by Adam, in place, then freeze them.

    Minimises the rollout error over windows: each component's squared error relative to the persistence baseline's.
    Parameters should be of magnitude 1, such as logarithms of factors, as they share the learning rate, which falls
    to 0.

    Args:
        physics: module of state and action, see :class:`~torchrl_gn.dynamics.Physics`.
        trajectories: ``[M]`` of ``state`` ``[M, T + 1, N, C]`` and ``action`` ``[M, T, A]``.
        steps: optimiser steps.
        window: steps of each rollout.

    Returns:
        The error of every optimiser step.

    Raises:
        FloatingPointError: if a gradient is not finite; nothing changes at that step.
        ValueError: if no parameter requires a gradient, or trajectories are not finite, or of another control step or
            shape.
    """
    layout = scene.layout
    check_counts(steps=steps, window=window, batch_size=batch_size)
    check_trajectories(trajectories, scene, layout=layout)
    parameters = [parameter for parameter in physics.parameters() if parameter.requires_grad]
    if not parameters:
        raise ValueError("The physics have no parameter that requires a gradient: there is nothing to fit.")
    device = parameters[0].device
    moving = torch.as_tensor(scene.predicted, device=device)
    buffer = trajectory_buffer(trajectories, batch_size=batch_size, window=window, seed=seed)
    optimizer = torch.optim.Adam(parameters, lr=lr)
    errors: list[float] = []
    controls = ControlInputs(scene).to(device)
    for step in range(steps):
        batch = buffer.sample().to(device)
        actions, truth = controls.commands(cast(Tensor, batch["action"])), cast(Tensor, batch["next", "state"])
        start = state = cast(Tensor, batch["state"])[:, 0]
        predicted = []
        for action in actions.unbind(1):
            predicted.append(state := physics(state, action))
        error, baseline = (
            squared_errors(each, truth, layout)[:, :, moving].mean((0, 1, 2))
            for each in (torch.stack(predicted, dim=1), start.unsqueeze(1).expand_as(truth))
        )
        moves = baseline > 0
        loss = (error[moves] / baseline[moves]).mean()
        optimizer.zero_grad()
        loss.backward()
        clip_gradients(parameters, 1.0, f"step {step} of fitting the physics")
        optimizer.param_groups[0]["lr"] = lr * (1 - step / steps)
        optimizer.step()
        errors.append(float(loss.detach()))
    physics.requires_grad_(False)
    return errors
