"""Baselines of the forward model's speed: its network in jraph, and MuJoCo itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import mujoco
import numpy as np
from mujoco.rollout import Rollout
from omegaconf import DictConfig
from torch import Tensor

from torchrl_gn.data import sample_start_states
from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.scenes import Scene

Run = Callable[[], object] | None


class Baseline(Protocol):
    """Baseline to time in turn with the forward model; a method returns None for work that the baseline lacks."""

    def step(self, state: Tensor, action: Tensor) -> Run:
        """Return the call for one step of states ``[B, N, 13]`` under actions ``[B, A]``."""
        ...

    def rollout(self, state: Tensor, actions: Tensor) -> Run:
        """Return the call for all steps under actions ``[B, T, A]``."""
        ...

    def gradient(self, state: Tensor, action: Tensor) -> Run:
        """Return the call for the gradients of a step's inputs, given the gradient of its output."""
        ...


class MuJoCoBaseline:
    """The true physics in MuJoCo's C code, at the scene's settings, on one thread, from start states of the scene."""

    def __init__(self, scene: Scene, seed: int) -> None:
        self._scene, self._seed = scene, seed
        self._data, self._pool = [mujoco.MjData(scene.model)], Rollout(nthread=0)

    def step(self, state: Tensor, action: Tensor) -> Run:
        return self.rollout(state, action.unsqueeze(1))

    def rollout(self, state: Tensor, actions: Tensor) -> Run:
        scene, count = self._scene, len(state)
        start = sample_start_states(scene, count, self._seed)
        controls = actions.double().repeat_interleave(scene.substeps, dim=1).numpy()
        steps = controls.shape[1]
        after = np.zeros((count, steps, scene.physics_size))
        arrays: dict[str, Any] = {"initial_state": start, "control": controls, "nstep": steps, "state": after}
        models = [scene.model] * count
        return lambda: self._pool.rollout(models, self._data, skip_checks=True, **arrays)

    def gradient(self, state: Tensor, action: Tensor) -> Run:
        return None


def make_baselines(cfg: DictConfig, model: ForwardModel, scene: Scene, names: Sequence[str]) -> dict[str, Baseline]:
    """Make baselines by name; ValueError if one is not known, ImportError if a package is missing."""

    def make_jraph() -> Baseline:
        from _common.jraph_network import JraphBaseline  # needs packages that the others do without

        return JraphBaseline(model, scene, cfg.threads)

    kinds: dict[str, Callable[[], Baseline]] = {
        "jraph": make_jraph,
        "mujoco": lambda: MuJoCoBaseline(scene, cfg.seed),
    }
    if unknown := [name for name in names if name not in kinds]:
        raise ValueError(f"baselines={unknown} are not known; use any of {list(kinds)}.")
    return {name: kinds[name]() for name in names}
