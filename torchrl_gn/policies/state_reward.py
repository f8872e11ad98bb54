"""Reward of a scene's steps, learned from observed rewards."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchrl_gn.dynamics import Canonicalizer
from torchrl_gn.maths.normalizer import Normalizer
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.networks.core import dtype_of
from torchrl_gn.networks.layer_norm_mlp import LayerNormMLP
from torchrl_gn.policies.state_features import StateFeatures, check_hidden
from torchrl_gn.rewards import Reward
from torchrl_gn.scenes import Scene


class StateReward(Reward):
    """Learned reward of a step: a network over its action and the state's features before and after.

    The features are :class:`~torchrl_gn.policies.StateFeatures`. Use it for tasks whose reward is unknown or has no
    gradient; the network's reward is smooth. A linear part lets a reward for speed grow beyond the data. Train it with
    :func:`~torchrl_gn.training.fit_reward`; it returns 0 until then.

    Args:
        hidden: hidden sizes of the network (:class:`~torchrl_gn.networks.layer_norm_mlp.LayerNormMLP`).
        canonicalizer, target: see :class:`~torchrl_gn.policies.StateFeatures`; the target is the task, ``[*B, 3]``.

    Example:
        >>> from torchrl_gn.scenes import load_scene
        >>> reward = StateReward(scene := load_scene("pendulum"))
        >>> state = torch.zeros(5, scene.num_nodes, 13)
        >>> reward(state, torch.zeros(5, 1), state).shape
        torch.Size([5, 1])
    """

    scale: Tensor

    def __init__(
        self,
        scene: Scene,
        *,
        hidden: Sequence[int] = (128, 128),
        canonicalizer: Canonicalizer | None = None,
        target: bool = False,
    ) -> None:
        super().__init__()
        self.hidden, self.features = check_hidden(hidden), StateFeatures(scene, canonicalizer, target=target)
        self.target_shape = (3,) if target else None
        self.shown = {"scene": scene.name, "hidden": self.hidden}
        self.network = LayerNormMLP(2 * self.features.size + scene.num_actions, 1, self.hidden, linear=True)
        self.normalizer = Normalizer(1)
        half_range = (torch.as_tensor(scene.action_high) - torch.as_tensor(scene.action_low)) / 2
        usable = half_range.isfinite() & (half_range > 0)
        self.register_buffer("scale", torch.where(usable, half_range, 1.0).float(), persistent=False)

    @property
    def scene(self) -> Scene:
        return self.features.scene

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        target = self._target(task, next_state)
        target = None if target is None else target.expand(2, *target.shape)
        before, after = self._features(torch.stack((state, next_state)), target)  # half as many operations
        return self._of(before, action, after).to(next_state.dtype)

    @without_autocast
    def along(self, states: Tensor, actions: Tensor, task: Tensor | None = None) -> Tensor:
        features = self._features(states, self._target(task, states))
        return self._of(features[..., :-1, :], actions, features[..., 1:, :]).to(states.dtype)

    def _target(self, task: Tensor | None, states: Tensor) -> Tensor | None:
        """Return the target of each state ``[*B, 3]``; None if the reward has none."""
        if self.target_shape is None:
            return None
        return self.require_task(task, states).expand(*states.shape[:-2], 3)

    def _features(self, states: Tensor, target: Tensor | None) -> Tensor:
        return self.features(states, dtype_of(self.network), target)

    def _of(self, before: Tensor, action: Tensor, after: Tensor) -> Tensor:
        """Return rewards ``[*B, 1]`` of features ``[*B, F]`` before and after an action."""
        return self.normalizer.inverse(self.network(self.inputs(before, action, after)))

    def inputs(self, before: Tensor, action: Tensor, after: Tensor) -> Tensor:
        """Concatenate features ``[*B, F]`` before and after an action with the action: ``[*B, 2 F + A]``."""
        return torch.cat((before, after, (action / self.scale.to(action.dtype)).to(after.dtype)), -1)

    def description(self) -> dict[str, Any]:
        """Return JSON-able values from which :meth:`from_description` rebuilds the network."""
        return {**self.features.description(), "hidden": self.hidden}

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> StateReward:
        """Build the network of a :meth:`description`, with fresh weights."""
        return cls(**StateFeatures.arguments_from(description))
