"""Errors of a model on trajectories that nothing has seen, the same ones every time."""

from __future__ import annotations

from typing import cast

import numpy as np
from tensordict import TensorDictBase

from torchrl_gn.data import collect_trajectories
from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.evaluation.error_table import ErrorTable
from torchrl_gn.evaluation.errors import HORIZONS, evaluate_errors
from torchrl_gn.evaluation.identification import identification_errors
from torchrl_gn.identification import IdentifyingModel
from torchrl_gn.scenes import Scene, sample_variants


def fresh_errors(
    model: ForwardModel | IdentifyingModel, scene: Scene, *, sequences: int, length: int, seed: int, phase: int = 20
) -> ErrorTable:
    """Collect random trajectories of a scene and measure a model on them.

    A model that identifies is measured on random variants of the scene, each identified from one trajectory and
    measured on another.

    Args:
        model: the model.
        scene: the scene.
        sequences: how many trajectories, or variants.
        length: control steps of each.
        seed: of the trajectories, and variants.
        phase: steps to identify from.

    Raises:
        ValueError: if trajectories are shorter than the longest rollouts to measure, 100 steps, or the model identifies
            and the scene is no system of the paper with variants.
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
    return identification_errors(*model.bind(scene), observed, predicted, steps=phase)
