"""A policy over a scene's states, which proposes plans."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_gn.dynamics import Canonicalizer
from torchrl_gn.networks.layer_norm_mlp import LayerNormMLP
from torchrl_gn.planners.state_features import StateFeatures, check_hidden
from torchrl_gn.scenes import Scene


class StatePolicy(TensorDictModuleBase):
    """Deterministic action within the scene's bounds, from ``state`` ``[*B, N, 13]`` to ``action`` ``[*B, A]``.

    A network over the scene's :class:`~torchrl_gn.planners.StateFeatures`, learned from a planner's episodes by
    :func:`~torchrl_gn.training.fit_policy`; a planner's ``proposal``. Differentiable.

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

    @property
    def scene(self) -> Scene:
        return self.features.scene

    @property
    def fitted(self) -> bool:
        """Whether it has learned from data. Waits for the device."""
        return self.features.normalizer.fitted

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", self.act(tensordict["state"]))

    def act(self, state: Tensor) -> Tensor:
        """Actions ``[*B, A]`` in states ``[*B, N, 13]``; ValueError for another shape."""
        features = self.features(state, next(self.network.parameters()).dtype)
        return self.middle + self.half_range * self.scaled(features)

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
