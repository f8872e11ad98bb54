"""Evaluate a trained model in one call: errors and pictures, or errors on newly collected trajectories."""

from __future__ import annotations

import os
from pathlib import Path
from typing import cast

import numpy as np
from tensordict import TensorDictBase

from torchrl_gn.data import collect_trajectories
from torchrl_gn.dynamics import ForwardModel, Predictor
from torchrl_gn.evaluation.error_table import ErrorTable
from torchrl_gn.evaluation.errors import HORIZONS, evaluate_errors
from torchrl_gn.evaluation.figures import plot_errors
from torchrl_gn.evaluation.identification import identification_errors
from torchrl_gn.evaluation.motion_figures import plot_body_trajectory
from torchrl_gn.evaluation.video import rollout_video
from torchrl_gn.identification import IdentifyingModel
from torchrl_gn.scenes import Scene, sample_variants


def report(
    model: Predictor,
    trajectories: TensorDictBase,
    folder: str | os.PathLike,
    *,
    horizons: tuple[int, ...] = HORIZONS,
    scene: Scene | None = None,
) -> tuple[ErrorTable, list[Path]]:
    """Evaluate a model, bound to the scene of the trajectories, and draw the first of them.

    Args:
        trajectories: ``[M]`` with ``state`` ``[M, T + 1, N, 13]``, ``action`` ``[M, T, A]`` and physical parameters at
            the model's ``parameters_key`` if it has one.
        scene: scene of the first trajectory, if that is a variant of the model's.

    Returns:
        The error table, and the written files: ``prediction.png`` (one body), ``errors.png`` and ``rollout.gif``.
    """
    folder, scene = Path(folder), scene or model.scene
    table = evaluate_errors(model, trajectories, horizons=horizons, keep=1)
    truth, prediction = trajectories["state"][0, : table.rollouts.shape[1]], table.rollouts[0]
    finite = prediction.isfinite().flatten(1).all(1)
    length = int(finite.long().cumprod(0).sum())
    truth, prediction = truth[:length], prediction[:length]
    files = [
        plot_body_trajectory(truth, prediction, scene, folder / "prediction.png"),
        plot_errors({scene.name: table}, folder / "errors.png"),
        rollout_video(scene, truth, prediction, folder / "rollout.gif", speed=min(1.0, scene.timestep / 0.01)),
    ]
    return table, files


def fresh_errors(
    model: ForwardModel | IdentifyingModel,
    scene: Scene,
    *,
    sequences: int,
    length: int,
    seed: int,
    context_length: int = 20,
) -> ErrorTable:
    """Evaluate a model on new random trajectories of a scene, the same ones for the same seed.

    A model that identifies is evaluated on random variants of the scene: each is identified from one trajectory
    (``context_length`` steps) and predicted on another. ``length`` in control steps must be at least 100.
    """
    if length < max(HORIZONS):
        raise ValueError(f"length={length} is too short: errors are measured over rollouts of {max(HORIZONS)} steps.")
    if isinstance(model, ForwardModel):
        trajectories = collect_trajectories(scene, sequences, length, seed, split=3)
        return evaluate_errors(model.bind(scene), trajectories)
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(5,)))
    variants = sample_variants(scene.origin.get("system", scene.name), sequences, rng)
    both = collect_trajectories(variants, 2 * sequences, length, seed, split=4)
    observed, predicted = (cast(TensorDictBase, half) for half in (both[:sequences], both[sequences:]))
    return identification_errors(*model.bind(scene), observed, predicted, steps=context_length)
