"""Collect trajectories under random control, in memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_gn.data.controls import spline_controls
from torchrl_gn.data.simulate import Simulator, UnstableSimulationError
from torchrl_gn.data.start_states import draw_start_states
from torchrl_gn.scenes.physical_parameters import PhysicalParameters
from torchrl_gn.scenes.scene import Scene

CHUNK = 250  # sequences per derived seed; data depend on it, so it never changes
_ATTEMPTS = 20
_MAX_REJECTED = 0.1


def collect_trajectories(
    scene: Scene | Sequence[Scene],
    num: int,
    steps: int = 100,
    seed: int = 0,
    *,
    split: int = 0,
    knot_interval: float = 10.0,
    simulator: Simulator | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> TensorDict:
    """Simulate a scene from :func:`~torchrl_gn.data.sample_start_states` under random control (paper, SM "Datasets").

    Args:
        scene: the scene, or variants of one, which the sequences take in turn.
        split: index of an independent split; data sets use 0, 1, 2.
        knot_interval: as of :func:`~torchrl_gn.data.spline_controls`.
        simulator: simulator of the same scenes, to reuse its threads.
        progress: called with the numbers of sequences done and wanted.

    Returns:
        TensorDict ``[num]``, float64: ``state`` ``[num, T+1, N, 13]``, ``action`` ``[num, T, A]``, ``physics``
        ``[num, T+1, S]``; with variants also ``parameters`` (:class:`~torchrl_gn.scenes.PhysicalParameters`).

    Raises:
        UnstableSimulationError: over a tenth, and over ten, of 250 simulations are unstable; fewer are redrawn.
    """
    if num < 1 or steps < 1:
        raise ValueError(f"num and steps must be at least 1, got num={num}, steps={steps}")
    simulator = simulator or Simulator(scene)
    if simulator.scenes != ((scene,) if isinstance(scene, Scene) else tuple(scene)):
        raise ValueError(f"simulator is of another {simulator.scene.name!r} than the scene; give both the same.")
    chunks = []
    for first in range(0, num, CHUNK):
        count = min(CHUNK, num - first)
        variant = np.arange(first, first + count) % len(simulator.scenes)
        chunk, _ = collect_chunk(simulator, variant, steps, seed, (split, first // CHUNK), knot_interval=knot_interval)
        if not isinstance(scene, Scene):
            chunk["parameters"] = variant_parameters(simulator.scenes, variant)
        chunks.append(chunk)
        if progress is not None:
            progress(first + count, num)
    return cast(TensorDict, torch.cat(chunks)) if len(chunks) > 1 else chunks[0]


def variant_parameters(scenes: Sequence[Scene], variant: np.ndarray) -> TensorDict:
    """Physical parameters ``[n]`` of the scenes ``variant`` ``[n]``."""
    which, row = np.unique(variant, return_inverse=True)
    values = torch.stack([PhysicalParameters.of(scenes[index]).tensordict() for index in which])
    return cast(TensorDict, values[torch.from_numpy(row)])


def collect_chunk(
    simulator: Simulator, variant: np.ndarray, steps: int, seed: int, key: tuple[int, ...], *, knot_interval: float
) -> tuple[TensorDict, int]:
    """Simulate sequences ``[count]`` of the scenes ``variant`` ``[count]``; returns also the number of redrawn ones."""
    scene, count = simulator.scene, len(variant)
    result, rejected, pending = None, 0, torch.arange(count)
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(*key, attempt)))
        own = variant[pending.numpy()]
        start, bad_starts = draw_start_states(simulator, own, rng)
        action = spline_controls(scene, len(pending), steps, rng, knot_interval=knot_interval)
        drawn = simulator.rollout(start, action, own)
        drawn["action"] = torch.from_numpy(action)
        stable = drawn.pop("stable")
        if result is None:
            result = drawn
        else:
            result[pending] = drawn
        pending = pending[~stable]
        rejected += len(pending) + bad_starts
        if rejected > max(_MAX_REJECTED * count, 10):
            break
        if not len(pending):
            return result, rejected
    raise UnstableSimulationError(
        f"{rejected} simulations of {scene.name!r} became unstable while drawing {count} sequences of {steps} steps. "
        "Use a smaller physics step in the model, smaller action bounds, or a larger knot_interval."
    )
