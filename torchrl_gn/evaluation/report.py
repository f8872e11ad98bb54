"""Everything a person wants to see of a trained forward model, in one call."""

from __future__ import annotations

import os
from pathlib import Path

from tensordict import TensorDictBase

from torchrl_gn.dynamics import Predictor
from torchrl_gn.evaluation.error_table import ErrorTable
from torchrl_gn.evaluation.errors import HORIZONS, evaluate_errors
from torchrl_gn.evaluation.figures import plot_errors
from torchrl_gn.evaluation.motion_figures import plot_body_trajectory
from torchrl_gn.evaluation.video import rollout_video
from torchrl_gn.scenes import Scene


def report(
    model: Predictor,
    trajectories: TensorDictBase,
    folder: str | os.PathLike,
    *,
    horizons: tuple[int, ...] = HORIZONS,
    scene: Scene | None = None,
) -> tuple[ErrorTable, list[Path]]:
    """Evaluate a model on test trajectories and draw what it does.

    Args:
        model: the model, bound to the scene of the trajectories.
        trajectories: ``[M]`` test trajectories, ``state`` ``[M, T + 1, N, 13]`` and ``action`` ``[M, T, A]``, and
            physical parameters at the model's ``parameters_key`` if it has one.
        folder: where the files go.
        horizons: steps of the rollout errors.
        scene: scene of the first trajectory, which is drawn, if that is a variant of the model's.

    Returns:
        The error table, and the written files: the paper's figure of one body
        (``prediction.png``), the errors as bars (``errors.png``) and truth beside
        prediction of the first trajectory (``rollout.gif``).
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
