"""Policies that are graph networks."""

from __future__ import annotations

from typing import Any, cast

import torch
from tensordict.nn import NormalParamExtractor
from torch import Tensor, nn

from torchrl_gn.policies.observation_network import ObservationNetwork, sharing_weights
from torchrl_gn.scenes import ObservationGraph


class GraphPolicy(nn.Module):
    """Location and scale of a Gaussian policy from a graph network: each joint's actions are read at the node it moves.

    For TorchRL's ``ProbabilisticActor``. Without identities in the graph the same weights serve bodies of any number of
    joints (:meth:`for_graph`), which the paper does not try. ``options`` are those of :class:`ObservationNetwork`.

    Raises:
        ValueError: if the graph has no actions.
    """

    take: Tensor

    def __init__(self, graph: ObservationGraph, *, min_scale: float = 0.01, **options: Any) -> None:
        super().__init__()
        if not graph.num_actions:
            raise ValueError(f"Graph {graph.name!r} has no actions for a policy to choose.")
        self.network = ObservationNetwork(graph, 2 * graph.node_actions.shape[1], actions=False, **options)
        self.extract = NormalParamExtractor(scale_lb=cast(Any, min_scale))
        self.register_buffer("take", torch.as_tensor(graph.action_at), persistent=False)

    def for_graph(self, graph: ObservationGraph) -> GraphPolicy:
        """The same weights for another graph, see :meth:`ObservationNetwork.for_graph`."""
        policy = sharing_weights(self)
        policy.network = self.network.for_graph(graph)
        policy.take = torch.as_tensor(graph.action_at).to(self.take.device)
        return policy

    def update_normalizers(self, observation: Tensor) -> None:
        """Add observations ``[*B, O]`` to the statistics."""
        self.network.update_normalizers(observation)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Location and scale ``[*B, A]`` of the actions, before they are squashed, for observations ``[*B, O]``."""
        loc, scale = self.network(observation).chunk(2, dim=-1)
        return self.extract(torch.cat([part.flatten(-2)[..., self.take] for part in (loc, scale)], dim=-1))
