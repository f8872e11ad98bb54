"""Baselines of the forward model's speed: its network in jraph, and MuJoCo itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import mujoco
import numpy as np
import torch
from mujoco.rollout import Rollout
from omegaconf import DictConfig
from torch import Tensor

from torchrl_gn.data import sample_start_states
from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.networks import Graph
from torchrl_gn.scenes import Scene

Run = Callable[[], object] | None
_TOLERANCE = 1e-5  # largest difference between jraph's outputs and ours, relative to their norm


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


class JraphBaseline:
    """The network alone, graph features in and output nodes out, written with jraph under ``jax.jit``.

    Raises:
        ImportError: without jax or jraph.
        RuntimeError: if its outputs differ from our network's.
    """

    def __init__(self, model: ForwardModel, scene: Scene, threads: int) -> None:
        from _common import jraph_network as other

        other.limit_threads(threads)
        self._batched, self._network = other.batched, other.JraphNetwork(model.core)  # type: ignore[arg-type]
        self._reference = model.bind(scene, reference=True)

    def step(self, state: Tensor, action: Tensor) -> Run:
        graph, expected = self._seen(state, action)
        inputs = self._batched(graph)
        found = torch.from_numpy(np.array(self._network.predict(inputs))).view_as(expected)
        if (error := float((found - expected).norm() / expected.norm())) > _TOLERANCE:
            raise RuntimeError(f"jraph's outputs differ from the core's by {error:.1e} of their norm.")
        return lambda: self._network.predict(inputs)

    def rollout(self, state: Tensor, actions: Tensor) -> Run:
        return None

    def gradient(self, state: Tensor, action: Tensor) -> Run:
        inputs = self._batched(self._seen(state, action)[0])
        gradient = self._network.predict(inputs)  # gradient of half the outputs' sum of squares
        return lambda: self._network.gradient(inputs, gradient)

    @torch.no_grad()
    def _seen(self, state: Tensor, action: Tensor) -> tuple[Graph, Tensor]:
        """Return the graph that the core reads in a step, and its output nodes."""
        seen: list[tuple[Graph, Tensor]] = []
        core = self._reference.model.core
        handle = core.register_forward_hook(lambda _, inputs, output: seen.append((inputs[0], output.nodes)))
        self._reference.step(state, action)
        handle.remove()
        return seen[0]


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
    kinds: dict[str, Callable[[], Baseline]] = {
        "jraph": lambda: JraphBaseline(model, scene, cfg.threads),
        "mujoco": lambda: MuJoCoBaseline(scene, cfg.seed),
    }
    if unknown := [name for name in names if name not in kinds]:
        raise ValueError(f"baselines={unknown} are not known; use any of {list(kinds)}.")
    return {name: kinds[name]() for name in names}
