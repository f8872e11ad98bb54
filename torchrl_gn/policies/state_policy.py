"""Policy over a scene's states, which can also propose plans."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from torchrl_gn.dynamics import Canonicalizer
from torchrl_gn.networks.layer_norm_mlp import LayerNormMLP
from torchrl_gn.policies.bounded_policy import BoundedPolicy
from torchrl_gn.policies.state_features import StateFeatures, check_hidden
from torchrl_gn.scenes import Scene
from torchrl_gn.scenes.articulation import require_same_nodes, require_timestep


class StatePolicy(BoundedPolicy):
    """Policy from ``state`` ``[*B, N, 13]`` to ``action`` ``[*B, A]`` within the scene's bounds.

    It is a network over the scene's :class:`~torchrl_gn.policies.StateFeatures`, differentiable. Train it on a
    planner's episodes by :func:`~torchrl_gn.training.fit_policy`, or through a model by
    :class:`~torchrl_gn.objectives.SHACLoss`; it can be a planner's ``proposal``. It explores under TorchRL's
    exploration type RANDOM: it adds Gaussian noise before the tanh that bounds the actions, with a learned standard
    deviation for each action.

    Args:
        hidden: hidden sizes of the network (:class:`~torchrl_gn.networks.layer_norm_mlp.LayerNormMLP`).
        canonicalizer, target: see :class:`~torchrl_gn.policies.StateFeatures`.

    Raises:
        ValueError: the scene has no actions, or actions without bounds.

    Example:
        >>> import torch
        >>> from torchrl_gn.scenes import load_scene
        >>> policy = StatePolicy(load_scene("pendulum"))
        >>> policy.act(torch.zeros(5, policy.scene.num_nodes, 13)).shape
        torch.Size([5, 1])
    """

    features: StateFeatures  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(
        self,
        scene: Scene,
        *,
        hidden: Sequence[int] = (128, 128),
        canonicalizer: Canonicalizer | None = None,
        target: bool = False,
    ) -> None:
        super().__init__(scene, scene.num_actions)
        self.hidden, self.features = check_hidden(hidden), StateFeatures(scene, canonicalizer, target=target)
        self.in_keys += ["target"] if target else []
        self.network = LayerNormMLP(self.features.size, scene.num_actions, self.hidden)

    def for_scene(self, scene: Scene) -> StatePolicy:
        require_same_nodes(scene, self.scene, "The policy")
        self.require_actions(scene)
        require_timestep(scene, self.scene.timestep, "The policy")
        return self

    @property
    def targeted(self) -> bool:
        return self.features.target

    def unbounded(self, state: Tensor, target: Tensor | None = None) -> Tensor:
        return self.network(self.features(state, next(self.network.parameters()).dtype, target))

    def scaled(self, features: Tensor) -> Tensor:
        """Return actions ``[*B, A]`` in units of half their range, -1 to 1, from features ``[*B, F]``."""
        return self.network(features).tanh()

    def description(self) -> dict[str, Any]:
        return {**self.features.description(), "hidden": self.hidden}

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> StatePolicy:
        return cls(**StateFeatures.arguments_from(description))
