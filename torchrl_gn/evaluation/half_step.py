"""MuJoCo's own numerical errors: how far a simulation at half the physics step differs."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_gn.checks import sorted_horizons
from torchrl_gn.data.simulate import Simulator
from torchrl_gn.dynamics.parameters import refuse_variants
from torchrl_gn.evaluation.calibration import fixed_components
from torchrl_gn.evaluation.error_table import ErrorTable
from torchrl_gn.evaluation.errors import HORIZONS, ErrorSums
from torchrl_gn.scenes import Scene
from torchrl_gn.scenes.checked_trajectories import check_trajectories


def half_step_errors(
    scene: Scene, trajectories: TensorDictBase, *, horizons: Sequence[int] = HORIZONS, num_threads: int | None = None
) -> ErrorTable:
    """Return the errors of simulations at half the physics step, relative to the persistence baseline.

    If a robot falls or stumbles, its simulation is no more accurate than this: a model's error of that size may be the
    simulation's own.

    Args:
        trajectories: ``[M]`` simulated, with ``state`` ``[M, T + 1, N, C]``, ``physics`` ``[M, T + 1, S]`` and
            ``action`` ``[M, T, A]``.

    Raises:
        KeyError: if the trajectories have no ``physics``.
        ValueError: if they are of variants, whose ``parameters`` are not the scene's, not finite, of another control
            step or shape, or shorter than a horizon.
    """
    refuse_variants(scene, trajectories)
    check_trajectories(trajectories, scene, layout=scene.layout)
    horizons, steps = sorted_horizons(horizons), trajectories["action"].shape[1]
    if not horizons or horizons[-1] > steps:
        raise ValueError(f"horizons={list(horizons)} must be from 1 to the trajectories' {steps} steps.")
    simulator = Simulator(with_half_step(scene), num_threads)
    state, physics, action = (cast(Tensor, trajectories[key]) for key in ("state", "physics", "action"))
    count = len(action)
    predicted = torch.from_numpy(np.flatnonzero(scene.predicted))
    single, rollouts = (ErrorSums(size, scene.layout, predicted) for size in (1, horizons[-1]))
    after = simulator.rollout(physics[:, :-1].flatten(0, 1), action.flatten(0, 1).unsqueeze(1))["state"][:, 1]
    single.add(0, after, state[:, 1:].flatten(0, 1), state[:, :-1].flatten(0, 1))
    path = simulator.rollout(physics[:, 0], action[:, : horizons[-1]])["state"]
    for step in range(1, horizons[-1] + 1):
        rollouts.add(step - 1, path[:, step], state[:, step], state[:, 0])
    fixed = fixed_components(scene, scene.layout)
    errors = [single.error("one_step_error", 1, count, steps, fixed)]
    errors += [rollouts.error(f"rollout_error_{horizon}", horizon, count, horizon, fixed) for horizon in horizons]
    return ErrorTable({error.name: error for error in errors}, state.new_zeros((0, 1, *state.shape[2:])))


def with_half_step(scene: Scene) -> Scene:
    """Return the scene with half its physics step and the same control step."""
    model = copy.copy(scene.model)
    model.opt.timestep /= 2
    if scene.delays.size:
        model.actuator_delay[:] = np.maximum(2 * scene.delays.lag - 0.5, 0) * model.opt.timestep
    return replace(scene, model=model, substeps=2 * scene.substeps)
