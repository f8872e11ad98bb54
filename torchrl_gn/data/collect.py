"""Collect trajectories under random control or a policy, in memory."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from typing import cast

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_gn.checks import check_counts, checked_seed
from torchrl_gn.data.policy_rollout import Policy, policy_rollout
from torchrl_gn.data.random_controls import Pace, random_controls
from torchrl_gn.data.simulate import Simulator, UnstableSimulationError, steadier_physics
from torchrl_gn.data.start_states import draw_start_states
from torchrl_gn.data.uncontrolled import warn_if_uncontrolled
from torchrl_gn.scenes.load import as_scene
from torchrl_gn.scenes.physical_parameters import PhysicalParameters, require_variant
from torchrl_gn.scenes.scene import Scene

CHUNK = 250  # sequences per derived seed; data depend on it, so it never changes
_OWN = 2**31  # split of collect_trajectories; 0 would be the training data of a data set with the same seed
_ATTEMPTS = 20
_MAX_REJECTED = 0.1
_BOUNDS: dict[str, Callable[[Tensor], Tensor]] = {  # of states [..., 13]
    "lowest": lambda state: state[..., 2],
    "highest": lambda state: state[..., 2],
    "distance": lambda state: state[..., :3].norm(dim=-1),
    "speed": lambda state: state[..., 7:10].norm(dim=-1),
    "angular_speed": lambda state: state[..., 10:13].norm(dim=-1),
}


def collect_trajectories(
    scene: Scene | str | os.PathLike | Sequence[Scene],
    num: int,
    steps: int = 100,
    seed: int = 0,
    *,
    split: int | None = None,
    knot_interval: float = 10.0,
    pace: Pace = "mixed",
    policy: Policy | None = None,
    bounds: Mapping[str, float] | None = None,
    redrawn: dict[str, int] | None = None,
    simulator: Simulator | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> TensorDict:
    """Simulate a scene from :func:`~torchrl_gn.data.sample_start_states` under random control or a policy.

    Paper: SM "Datasets". Sequences that become unstable or leave the bounds are drawn again. Warns
    (``UncontrolledSceneWarning``) if no action moves the scene.

    Args:
        scene: the scene, its name or path, or variants of one, which the sequences take in turn.
        seed: seed of start states and controls. No data set of :func:`create_dataset` has these sequences, whatever its
            seed: they can test a model that was trained on it.
        split: draw the sequences that a data set of this seed has in one split: 0 training, 1 validation, 2 test.
            Default: sequences that no split has.
        knot_interval, pace: see :func:`~torchrl_gn.data.random_controls`; unused with a policy.
        policy: TorchRL policy, or a function of a TensorDict ``[n]`` of ``state``, ``physics``, ``is_init`` and, for
            variants, ``variant``; ``n`` is at most 250. It writes or returns ``action`` ``[n, A]``. States have the
            dtype and device of its parameters. It explores (``ExplorationType.RANDOM``); ``seed`` seeds it.
        bounds: limits on every moving body: ``lowest`` and ``highest`` position along z, ``distance`` from the world's
            origin [m], ``speed`` [m/s], ``angular_speed`` [rad/s]. Default: none.
        redrawn: receives the numbers of redrawn sequences: ``unstable`` ones, and those ``outside`` the bounds.
        simulator: existing simulator of the same scenes, to reuse its threads.
        progress: called with the number of finished sequences and ``num``.

    Returns:
        TensorDict ``[num]``, float64: ``state`` ``[num, T+1, N, 13]``, ``action`` ``[num, T, A]``, ``physics``
        ``[num, T+1, S]``; with variants also ``parameters`` (:class:`~torchrl_gn.scenes.PhysicalParameters`).

    Raises:
        ValueError: the scenes are not variants of one: they differ in structure or in numbers that ``parameters`` lack.
        UnstableSimulationError: more than ten simulations, and more than a tenth, of a chunk (up to 250 sequences) are
            unstable, or some sequences fail twenty times in a row.
    """
    check_counts(num=num, steps=steps)
    check_bounds(bounds)
    scenes: Scene | Sequence[Scene] = as_scene(scene)
    simulator = simulator or Simulator(scenes)
    if simulator.scenes != ((scenes,) if isinstance(scenes, Scene) else tuple(scenes)):
        raise ValueError(f"The simulator's {simulator.scene.name!r} is not the given scene; give both the same.")
    for other in simulator.scenes[1:]:
        require_variant(simulator.scene, other)
    warn_if_uncontrolled(simulator, stacklevel=2)
    chunks, controls = [], {"knot_interval": knot_interval, "pace": pace}
    options = {**controls, "policy": policy, "bounds": bounds}
    split = _OWN if split is None else split
    redrawn = {} if redrawn is None else redrawn
    redrawn.update(unstable=0, outside=0)
    for first in range(0, num, CHUNK):
        count = min(CHUNK, num - first)
        variant = np.arange(first, first + count) % len(simulator.scenes)
        chunk, rejected = collect_chunk(simulator, variant, steps, seed, (split, first // CHUNK), **options)
        for cause, again in rejected.items():
            redrawn[cause] += again
        if not isinstance(scenes, Scene):
            chunk["parameters"] = variant_parameters(simulator.scenes, variant)
        chunks.append(chunk)
        if progress is not None:
            progress(first + count, num)
    return cast(TensorDict, torch.cat(chunks)) if len(chunks) > 1 else chunks[0]


def variant_parameters(scenes: Sequence[Scene], variant: np.ndarray) -> TensorDict:
    """Return the physical parameters ``[n]`` of the scenes with indices ``variant`` ``[n]``."""
    which, row = np.unique(variant, return_inverse=True)
    values = torch.stack([PhysicalParameters.of(scenes[index]).tensordict() for index in which])
    return cast(TensorDict, values[torch.from_numpy(row)])


def collect_chunk(
    simulator: Simulator,
    variant: np.ndarray,
    steps: int,
    seed: int,
    key: tuple[int, ...],
    *,
    knot_interval: float,
    pace: Pace,
    policy: Policy | None = None,
    bounds: Mapping[str, float] | None = None,
) -> tuple[TensorDict, dict[str, int]]:
    """Simulate sequences ``[count]`` of the scenes ``variant`` ``[count]``; return them and redraw counts by cause."""
    scene, count = simulator.scene, len(variant)
    result, pending, rejected = None, torch.arange(count, device="cpu"), {"unstable": 0, "outside": 0}
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng(np.random.SeedSequence(checked_seed(seed), spawn_key=(*key, attempt)))
        pending_variant = variant[pending.numpy()]
        start, bad_starts = draw_start_states(simulator, pending_variant, rng)
        if policy is None:
            controls = {"knot_interval": knot_interval, "pace": pace}
            action = random_controls(simulator, start, steps, rng, variant=pending_variant, **controls)
            drawn = simulator.rollout(start, action, pending_variant)
            drawn["action"] = torch.from_numpy(action)
        else:
            drawn = policy_rollout(simulator, start, steps, policy, pending_variant, int(rng.integers(2**31)))
        stable = drawn.pop("stable")
        inside = _inside(drawn["state"][:, :, torch.from_numpy(scene.predicted)], bounds or {})
        if result is None:
            result = drawn
        else:
            result[pending] = drawn
        pending = pending[~(stable & inside)]
        rejected["unstable"] += int((~stable).sum()) + bad_starts
        rejected["outside"] += int((stable & ~inside).sum())
        if rejected["unstable"] > max(_MAX_REJECTED * count, 10):
            raise UnstableSimulationError(
                f"{rejected['unstable']} simulations of {scene.name!r} became unstable while drawing {count} sequences"
                f" of {steps} steps. Use {steadier_physics(scene.model)}, smaller action bounds, or"
                f" {'a larger knot_interval' if policy is None else 'another policy'}."
            )
        if not len(pending):
            return result, rejected
    raise UnstableSimulationError(
        f"{len(pending)} of {count} sequences of {scene.name!r} with {steps} steps left the bounds {dict(bounds or {})}"
        f" or became unstable {_ATTEMPTS} times in a row. Use wider bounds, fewer steps or smaller actions."
    )


def check_bounds(bounds: Mapping[str, float] | None) -> None:
    """Raise ValueError for unknown or NaN bounds."""
    for name, value in (bounds or {}).items():
        if name not in _BOUNDS:
            raise ValueError(f"bounds have no {name!r}; use some of {list(_BOUNDS)}.")
        if math.isnan(value):
            raise ValueError(f"bounds[{name!r}] must be a number, got {value}")


def _inside(state: Tensor, bounds: Mapping[str, float]) -> Tensor:
    """Detect sequences ``[n]`` whose moving bodies ``[n, T+1, N, 13]`` stay within the bounds."""
    inside = torch.ones(len(state), dtype=torch.bool, device="cpu")
    for name, bound in bounds.items():
        values = _BOUNDS[name](state).flatten(1)
        inside &= ((values >= bound) if name == "lowest" else (values <= bound)).all(1)
    return inside
