"""Base class of policies over a scene's states: action bounds, exploration and TensorDict keys."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn.functional import softplus
from torchrl.envs.utils import ExplorationType, exploration_type

from torchrl_gn.policies.body_frame_features import BodyFrameFeatures
from torchrl_gn.policies.state_features import StateFeatures
from torchrl_gn.scenes import Scene

_LOG_STD, _LOG_STD_BOUNDS = -1.0, (-5.0, 1.0)  # initial value and limits


class BoundedPolicy(TensorDictModuleBase):
    """Policy from ``state`` ``[*B, N, 13]`` to float32 ``action`` ``[*B, A]`` within the scene's bounds.

    Policies for episodes with a target (:attr:`targeted`) also read ``target`` ``[*B, 3]``. The policy explores under
    TorchRL's exploration type RANDOM: it adds Gaussian noise before the tanh that bounds the actions.

    Args:
        stds: number of learned standard deviations.

    Raises:
        ValueError: the scene has no actions, or actions without bounds.
    """

    middle: Tensor
    half_range: Tensor
    features: StateFeatures | BodyFrameFeatures

    def __init__(self, scene: Scene, stds: int) -> None:
        super().__init__()
        self.in_keys: list[NestedKey] = ["state"]
        self.out_keys: list[NestedKey] = ["action"]
        self.log_std = nn.Parameter(torch.full((stds,), _LOG_STD))
        self.bound_to(scene)

    def bound_to(self, scene: Scene) -> None:
        """Bound actions as a scene does; ValueError if the scene has no actions, or some without bounds."""
        if not scene.num_actions or scene.unbounded:
            raise ValueError(f"Scene {scene.name!r} must have actions, all with bounds, for a policy to choose.")
        low, high = torch.as_tensor(scene.action_low), torch.as_tensor(scene.action_high)
        for name, bound in (("middle", (low + high) / 2), ("half_range", (high - low) / 2)):
            self.register_buffer(name, bound.float().to(self.log_std.device), persistent=False)

    @abstractmethod
    def for_scene(self, scene: Scene) -> BoundedPolicy:
        """Return the policy for a scene, with shared weights; ValueError if the scene or its timestep does not fit."""

    def require_actions(self, scene: Scene) -> None:
        """Raise ValueError if a scene's actions have other names than the policy's, or narrower bounds."""
        if scene.action_names != self.scene.action_names:
            raise ValueError(f"The policy's actions are {self.scene.action_names}, not {scene.action_names}.")
        (low, high), (least, most) = ((each.action_low, each.action_high) for each in (self.scene, scene))
        slack = 1e-6 * (high - low)
        if beyond := np.flatnonzero((low < least - slack) | (high > most + slack)).tolist():
            first = beyond[0]
            raise ValueError(
                f"The policy's action {scene.action_names[first]!r} is within {low[first]:g} and {high[first]:g},"
                f" beyond the {least[first]:g} and {most[first]:g} of scene {scene.name!r}."
            )

    @abstractmethod
    def unbounded(self, state: Tensor, target: Tensor | None = None) -> Tensor:
        """Return actions ``[*B, A]`` before the tanh, without exploration; ValueError for states of another shape."""

    @abstractmethod
    def description(self) -> dict[str, Any]:
        """Return JSON-able values from which :meth:`from_description` rebuilds the policy."""

    @classmethod
    @abstractmethod
    def from_description(cls, description: dict[str, Any]) -> BoundedPolicy:
        """Build the policy of a :meth:`description`, with fresh weights."""

    @property
    def scene(self) -> Scene:
        return self.features.scene

    @property
    def targeted(self) -> bool:
        """True if the policy reads the episode's target."""
        return False

    @property
    def fitted(self) -> bool:
        """True if the policy has learned from data; reading it synchronises with the device."""
        return self.features.fitted

    @property
    def log_stds(self) -> Tensor:
        """Log standard deviation of actions before the tanh, not yet limited: ``[A]``, or ``[1]`` for all actions."""
        return self.log_std

    @contextmanager
    def prepared(self) -> Iterator[None]:
        """Prepare the weights once for all actions in this context; gradients still reach them.

        The weights must not change inside the context.
        """
        yield

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        explores, state = exploration_type() == ExplorationType.RANDOM, tensordict["state"]
        target = tensordict["target"] if self.targeted else None
        action = self.sample(state, target=target)[0] if explores else self.act(state, target)
        return tensordict.set("action", action)

    def act(self, state: Tensor, target: Tensor | None = None) -> Tensor:
        """Return actions ``[*B, A]`` in states ``[*B, N, 13]``; ValueError for another shape."""
        return self._bounded(self.unbounded(state, target))

    def sample(
        self, state: Tensor, copies: int = 1, target: Tensor | None = None, noise: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Sample reparameterised actions ``[*B, A]``; also return log densities ``[*B]`` of actions scaled to -1 to 1.

        Args:
            copies: number of equal parts of the first dimension; all get the same noise.
            noise: ``[*B, A]`` of unit variance. Default: independent Gaussian noise.
        """
        std = self.log_stds.clamp(*_LOG_STD_BOUNDS).exp()
        before = self.unbounded(state, target)
        if noise is None:
            noise = torch.randn_like(before if copies == 1 else before.chunk(copies)[0])
            noise = noise if copies == 1 else torch.cat([noise] * copies)
        noise = noise.to(before)
        before = before + std * noise
        # log(1 - tanh(x)^2) = 2 (log 2 - x - softplus(-2 x)); the right side has no cancellation.
        slope = 2 * (math.log(2) - before - softplus(-2 * before))
        density = -0.5 * (noise.square() + math.log(2 * math.pi)) - std.log() - slope
        return self._bounded(before), density.sum(-1)

    def _bounded(self, before: Tensor) -> Tensor:
        """Return actions within the bounds in the environments' dtype, float32, whatever the network's dtype."""
        return self.middle.float() + self.half_range.float() * before.tanh().float()
