"""Value of a scene's states, learned from episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn

from torchrl_gn.checks import check_count
from torchrl_gn.dynamics import Canonicalizer
from torchrl_gn.maths.normalizer import Normalizer
from torchrl_gn.networks.layer_norm_mlp import LayerNormMLP
from torchrl_gn.policies.state_features import StateFeatures, check_hidden
from torchrl_gn.scenes import Scene

Combine = Literal["min", "mean"]


class StateValue(nn.Module):
    r"""Value of states: discounted return :math:`V(s) = \sum_k \gamma^k r_k` of the policy in the data.

    It is a few networks over the scene's :class:`~torchrl_gn.policies.StateFeatures`, twice differentiable. Use it as
    the ``terminal`` of environments to plan on, trained with :func:`~torchrl_gn.training.fit_value`, or as the critic
    of an actor-critic (:class:`~torchrl_gn.objectives.SHACLoss`). It returns 0 until it has learned.

    Args:
        discount: :math:`\gamma` of a control step.
        hidden: hidden sizes of each network (:class:`~torchrl_gn.networks.layer_norm_mlp.LayerNormMLP`).
        members: number of networks.
        combine: ``"min"`` takes the smallest value of the networks, which keeps a planner from states outside the data,
            where they disagree; ``"mean"`` suits a policy that learns from its own episodes and must find such states.
        canonicalizer, target: see :class:`~torchrl_gn.policies.StateFeatures`.

    Example:
        >>> import torch
        >>> from torchrl_gn.scenes import load_scene
        >>> scene = load_scene("pendulum")
        >>> StateValue(scene, discount=0.99)(torch.zeros(5, scene.num_nodes, 13)).shape
        torch.Size([5, 1])
    """

    def __init__(
        self,
        scene: Scene,
        *,
        discount: float = 0.99,
        hidden: Sequence[int] = (128, 128),
        members: int = 2,
        combine: Combine = "min",
        canonicalizer: Canonicalizer | None = None,
        target: bool = False,
    ) -> None:
        super().__init__()
        if not 0 < discount <= 1:
            raise ValueError(f"discount={discount} must be above 0 and at most 1.")
        check_count("members", members, 1)
        if combine not in get_args(Combine):
            raise ValueError(f"combine={combine!r} must be {' or '.join(get_args(Combine))}.")
        self.discount, self.hidden, self.combine = float(discount), check_hidden(hidden), combine
        self.features = StateFeatures(scene, canonicalizer, target=target)
        self.members = nn.ModuleList(LayerNormMLP(self.features.size, 1, self.hidden) for _ in range(members))
        self.normalizer = Normalizer(1)

    @property
    def scene(self) -> Scene:
        return self.features.scene

    @property
    def reads_task(self) -> bool:
        """True if the value depends on the episode's target, which is the task of its rewards."""
        return self.features.target

    @property
    def fitted(self) -> bool:
        """True if the value has learned from data; reading it synchronises with the device."""
        return self.normalizer.fitted

    def forward(self, state: Tensor, target: Tensor | None = None) -> Tensor:
        """Return values ``[*B, 1]`` of states ``[*B, N, 13]``, in their dtype; ValueError for another shape."""
        weight = next(self.members.parameters())
        return self.of_features(self.features(state, weight.dtype, target)).to(state.dtype)

    def of_features(self, features: Tensor) -> Tensor:
        """Return values ``[*B, 1]`` of features ``[*B, F]``."""
        each = self.normalized(features)
        return self.normalizer.inverse(each.amin(-1, True) if self.combine == "min" else each.mean(-1, True))

    def normalized(self, features: Tensor) -> Tensor:
        """Return each network's value ``[*B, members]``, in standard deviations from the mean."""
        return torch.cat([member(features) for member in self.members], dim=-1)

    def description(self) -> dict[str, Any]:
        """Return JSON-able values from which :meth:`from_description` rebuilds the network."""
        options = {
            "discount": self.discount,
            "hidden": self.hidden,
            "members": len(self.members),
            "combine": self.combine,
        }
        return {**self.features.description(), **options}

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> StateValue:
        """Build the network of a :meth:`description`, with fresh weights."""
        return cls(**StateFeatures.arguments_from(description))
