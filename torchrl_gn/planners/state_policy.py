"""A policy over a scene's states, which proposes plans."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn.functional import softplus
from torchrl.envs.utils import ExplorationType, exploration_type

from torchrl_gn.dynamics import Canonicalizer
from torchrl_gn.networks.layer_norm_mlp import LayerNormMLP
from torchrl_gn.planners.state_features import StateFeatures, check_hidden
from torchrl_gn.scenes import Scene

_LOG_STD, _LOG_STD_BOUNDS = -1.0, (-5.0, 1.0)  # at first, and where it may get


class StatePolicy(TensorDictModuleBase):
    """Action within the scene's bounds, from ``state`` ``[*B, N, 13]`` to ``action`` ``[*B, A]``.

    A network over the scene's :class:`~torchrl_gn.planners.StateFeatures`, learned from a planner's episodes by
    :func:`~torchrl_gn.training.fit_policy` or through a model by :class:`~torchrl_gn.objectives.SHACLoss`; also
    a planner's ``proposal``. Differentiable. Explores, with TorchRL's exploration type RANDOM, by noise before the
    tanh that bounds its actions, of one learned standard deviation for each.

    Raises:
        ValueError: the scene has no actions, or some without bounds.

    Example:
        >>> import torch
        >>> from torchrl_gn.scenes import load_scene
        >>> policy = StatePolicy(load_scene("pendulum"))
        >>> policy.act(torch.zeros(5, policy.scene.num_nodes, 13)).shape
        torch.Size([5, 1])
    """

    middle: Tensor
    half_range: Tensor

    def __init__(
        self, scene: Scene, *, hidden: Sequence[int] = (128, 128), canonicalizer: Canonicalizer | None = None
    ) -> None:
        super().__init__()
        if not scene.num_actions or scene.unbounded:
            raise ValueError(f"Scene {scene.name!r} must have actions, all with bounds, for a policy to choose.")
        self.in_keys: list[NestedKey] = ["state"]
        self.out_keys: list[NestedKey] = ["action"]
        self.hidden, self.features = check_hidden(hidden), StateFeatures(scene, canonicalizer)
        self.network = LayerNormMLP(self.features.size, scene.num_actions, self.hidden)
        low, high = torch.as_tensor(scene.action_low), torch.as_tensor(scene.action_high)
        self.register_buffer("middle", ((low + high) / 2).float(), persistent=False)
        self.register_buffer("half_range", ((high - low) / 2).float(), persistent=False)
        self.log_std = nn.Parameter(torch.full((scene.num_actions,), _LOG_STD))

    @property
    def scene(self) -> Scene:
        return self.features.scene

    @property
    def fitted(self) -> bool:
        """Whether it has learned from data. Waits for the device."""
        return self.features.normalizer.fitted

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        explores, state = exploration_type() == ExplorationType.RANDOM, tensordict["state"]
        return tensordict.set("action", self.sample(state)[0] if explores else self.act(state))

    def act(self, state: Tensor) -> Tensor:
        """Actions ``[*B, A]`` in states ``[*B, N, 13]``; ValueError for another shape."""
        features = self.features(state, next(self.network.parameters()).dtype)
        return self.middle + self.half_range * self.scaled(features)

    def sample(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Random actions ``[*B, A]``, reparameterised, and the log densities ``[*B]`` of their scaled ones."""
        features = self.features(state, next(self.network.parameters()).dtype)
        std = self.log_std.clamp(*_LOG_STD_BOUNDS).exp()
        noise = torch.randn_like(before := self.network(features))
        before = before + std * noise
        # log(1 - tanh(x)^2) = 2 (log 2 - x - softplus(-2 x)), which does not cancel.
        slope = 2 * (math.log(2) - before - softplus(-2 * before))
        density = -0.5 * (noise.square() + math.log(2 * math.pi)) - std.log() - slope
        return self.middle + self.half_range * before.tanh(), density.sum(-1)

    def scaled(self, features: Tensor) -> Tensor:
        """Actions ``[*B, A]`` in units of half their range, -1 to 1, of features ``[*B, F]``."""
        return self.network(features).tanh()

    def description(self) -> dict[str, Any]:
        """JSON-able values from which :meth:`from_description` rebuilds the policy."""
        return {**self.features.description(), "hidden": self.hidden}

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> StatePolicy:
        """Build the policy of a :meth:`description`, with fresh weights."""
        return cls(**StateFeatures.arguments_from(description))
