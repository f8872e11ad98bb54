"""Normalised features of a scene's states, for networks that judge or act in them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchrl_gn.dynamics import Canonicalizer
from torchrl_gn.finite import require_real
from torchrl_gn.maths import quaternion
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.normalizer import Normalizer
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.rewards.bodies import require_bodies
from torchrl_gn.scenes import PhysicalParameters, Scene, scene_from_description

_STATES = 16  # to compare rewards at
FLOOR, LIMIT = 1e-6, 5.0  # standard deviations: rounding noise, and where a planner has left the data


class StateFeatures(Float64Buffers):
    """The forward model's canonical state of all bodies, encoded and normalised, side by side.

    Features beyond five standard deviations are clipped. TypeError for a robot known by its joints alone.

    Args:
        canonicalizer: which of the scene's invariances are built in, see :func:`task_invariances`. Default: none.
        target: whether episodes have a target, a place ``[*B, 3]``, metres, world frame. Bodies are then seen from it
            along the axes on which the scene may be shifted, without ``recenter``; the others of it are features.
    """

    rest: Tensor
    pivot: Tensor
    shifted: Tensor

    def __init__(self, scene: Scene, canonicalizer: Canonicalizer | None = None, *, target: bool = False) -> None:
        super().__init__()
        require_bodies(scene)
        if target and canonicalizer is not None and canonicalizer.recenter:
            raise ValueError("Features of states and a target need recenter=False: where bodies are from it counts.")
        self.target = target
        self.scene, self.options = scene, canonicalizer or Canonicalizer(recenter=False, yaw=False)
        self.canonicalizer = self.options.bind(scene, scene.layout)
        self.physical = PhysicalParameters.of(scene)
        self.constants({"rest": self.physical.rest, "pivot": self.physical.pivot})
        self.constants({"shifted": np.outer(scene.predicted, scene.translation_invariant)})  # [N, 3]
        self.size = scene.num_nodes * scene.layout.encoded_size() + 3 * target
        self.normalizer = Normalizer(self.size, floor=FLOOR, limit=LIMIT)

    @property
    def fitted(self) -> bool:
        """Whether the normaliser has data. Waits for the device."""
        return self.normalizer.fitted

    @torch.no_grad()
    def fit(self, state: Tensor, target: Tensor | None = None) -> None:
        """Fit the normaliser to states ``[*B, N, 13]``, unless it has seen some; ValueError if one is not finite."""
        if not self.fitted:
            self.update(state, target)

    @torch.no_grad()
    def refit(self, state: Tensor, target: Tensor | None = None) -> None:
        """Fit the normaliser to states ``[*B, N, 13]`` alone; ValueError if one is not finite."""
        self.normalizer.reset()
        self.update(state, target)

    @torch.no_grad()
    @without_autocast
    def update(self, state: Tensor, target: Tensor | None = None) -> None:
        """Add states ``[*B, N, 13]`` to the normaliser; ValueError if one is not finite."""
        self.normalizer.update(self._encoded(state, target))

    @without_autocast
    def forward(self, state: Tensor, dtype: torch.dtype | None = None, target: Tensor | None = None) -> Tensor:
        """Features ``[*B, F]`` of states ``[*B, N, 13]``; differentiable. ValueError without a wanted target."""
        return self.normalizer(self._encoded(state, target), dtype)

    def _encoded(self, state: Tensor, target: Tensor | None) -> Tensor:
        check_states(self.scene, state)
        if not self.target:
            return self._of_bodies(state)
        if target is None or target.shape != (*state.shape[:-2], 3):
            given = None if target is None else list(target.shape)
            raise ValueError(f"States {list(state.shape)} need a target {[*state.shape[:-2], 3]}, got {given}.")
        target, free = target.to(state.dtype), self.shifted.to(state.dtype)
        seen = state - pad(target.unsqueeze(-2) * free, (0, state.shape[-1] - 3))
        return torch.cat((self._of_bodies(seen), target * (1 - free.amax(0))), -1)

    def _of_bodies(self, state: Tensor) -> Tensor:
        canonical = self.canonicalizer(state, self.physical._replace(rest=self.rest, pivot=self.pivot))
        return self.scene.layout.encode(canonical.state, "matrix", canonical.matrices).flatten(-2)

    def description(self) -> dict[str, Any]:
        """JSON-able values for :meth:`arguments_from`."""
        target = {"target": True} if self.target else {}
        return {"scene": self.scene.description(), "canonicalizer": asdict(self.options), **target}

    @staticmethod
    def arguments_from(description: dict[str, Any]) -> dict[str, Any]:
        """``scene``, ``canonicalizer`` and the other options of a network's description."""
        scene, canonicalizer = scene_from_description(description["scene"]), description["canonicalizer"]
        return {**description, "scene": scene, "canonicalizer": Canonicalizer(**canonicalizer)}


def task_invariances(scene: Scene, reward: Callable[..., Tensor]) -> Canonicalizer:
    """Which of a scene's invariances its reward ``(state, action, next_state, task) -> [*B, 1]`` has too.

    Compares rewards of random states with those of the same states moved and rotated.
    """
    generator = torch.Generator().manual_seed(0)
    state, next_state = torch.randn(2, _STATES, scene.num_nodes, scene.state_size, generator=generator).double()
    action = torch.randn(_STATES, scene.num_actions, generator=generator).double()
    for each in (state, next_state):
        where = each[..., BODY_STATE.slices["orientation"]]
        where.copy_(quaternion.normalize(where))
    inner = torch.as_tensor(scene.predicted).unsqueeze(-1)
    shift = torch.zeros(scene.state_size, dtype=torch.float64)
    shift[:3] = torch.as_tensor(scene.translation_invariant).double() * torch.tensor([0.7, -1.3, 0.4])
    before = reward(state, action, next_state, None)

    def keeps(moved: Callable[[Tensor], Tensor]) -> bool:
        moved_states = (torch.where(inner, moved(each), each) for each in (state, next_state))
        first, second = moved_states
        return bool(torch.allclose(reward(first, action, second, None), before, rtol=1e-9, atol=1e-9))

    yaw = False
    if (frame := scene.yaw_frame) is not None:
        rotation = torch.zeros(4, dtype=torch.float64)
        rotation[0], rotation[1 + frame.axis] = 0.8, 0.6
        yaw = keeps(lambda each: scene.layout.rotate(each, rotation.expand(_STATES, 4)))
    return Canonicalizer(recenter=keeps(lambda each: each + shift), yaw=yaw)


def check_states(scene: Scene, state: Tensor) -> None:
    """Raise ValueError unless states are ``[*B, N, 13]`` of the scene, TypeError unless they are a tensor."""
    require_real(state, "The state", whole=False)
    if state.shape[-2:] != (shape := (scene.num_nodes, scene.state_size)):
        raise ValueError(f"States of {scene.name!r} must be {['*B', *shape]}, got {list(state.shape)}.")


def check_hidden(hidden: Sequence[int]) -> list[int]:
    """Hidden sizes as a list; ValueError if one is not at least 1."""
    if not hidden or any(size < 1 or size != int(size) for size in hidden):
        raise ValueError(f"hidden={list(hidden)} must name hidden sizes of at least 1.")
    return [int(size) for size in hidden]
