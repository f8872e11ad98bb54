"""Networks of an agent that learns a policy, including graph-network policies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, cast

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import MLP, ProbabilisticActor, TanhModule, TanhNormal, ValueOperator

from torchrl_gn.maths.normalizer import unchanged_on_error
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.networks.core import dtype_of
from torchrl_gn.networks.layer_norm_mlp import LayerNormMLP
from torchrl_gn.policies.observation_model import ObservationModel
from torchrl_gn.policies.observation_network import ObservationNetwork, sharing_weights
from torchrl_gn.scenes import ObservationGraph


class LearnedReward(nn.Module):
    """Reward ``[*B, 1]`` as a network of observation, action and next observation, differentiable in all three."""

    def __init__(self, num_observations: int, num_actions: int, hidden: Sequence[int] = (128, 128)) -> None:
        super().__init__()
        self.mlp = MLP(2 * num_observations + num_actions, 1, num_cells=list(hidden), activation_class=nn.SiLU)

    @without_autocast
    def forward(self, observation: Tensor, action: Tensor, next_observation: Tensor) -> Tensor:
        together = torch.cat((observation, action, next_observation), dim=-1)
        return self.mlp(together.to(dtype_of(self.mlp))).to(together.dtype)


class OutputNormalization(nn.Module):
    r"""Bounded location :math:`\mu / \sqrt{1 + \overline{\mu^2}}`, with a mean square of at most 1.

    It keeps Adam from driving a policy into the flat ends of its tanh, where exploration stops. Wang et al. 2020
    ("Striving for simplicity") divide by the mean magnitude where it is above 1; this is a smooth version.
    """

    def forward(self, location: Tensor) -> Tensor:
        return location * (1 + location.square().mean(-1, keepdim=True)).rsqrt()


class GraphPolicy(nn.Module):
    """Location and scale of a Gaussian policy from a graph network: each joint's actions are read at the node it moves.

    Use it in TorchRL's ``ProbabilisticActor``. If the graph has no identities, the same weights serve bodies with any
    number of joints (:meth:`for_graph`); the paper does not try this. ``options`` are those of
    :class:`ObservationNetwork`. ValueError if the graph has no actions.
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
        """Return the policy for another graph, with shared weights; see :meth:`ObservationNetwork.for_graph`."""
        policy = sharing_weights(self)
        policy.network = self.network.for_graph(graph)
        policy.take = torch.as_tensor(graph.action_at).to(self.take.device)
        return policy

    def update_normalizers(self, observation: Tensor) -> None:
        """Add observations ``[*B, O]`` to the statistics."""
        self.network.update_normalizers(observation)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return location and scale ``[*B, A]`` of the actions before squashing, for observations ``[*B, O]``."""
        loc, scale = self.network(observation).to(observation.dtype).chunk(2, dim=-1)
        return self.extract(torch.cat([part.flatten(-2)[..., self.take] for part in (loc, scale)], dim=-1))


class Agent(nn.Module):
    """Policy and value on one task's flat observations, with an optional forward model and reward to plan with.

    Each is a module for TorchRL's losses and collectors. Actions lie in -1 to 1, as in the suite: policies end in
    :class:`OutputNormalization` and a tanh.

    Args:
        graph: layout of the task's observations and actions.
        stochastic: True for a Gaussian policy, squashed by a tanh (SVG); False for a deterministic one (DDPG).
        policy: ``"mlp"``, or ``"graph"``: a :class:`~torchrl_gn.policies.GraphPolicy`, which must be stochastic.
        hidden: hidden sizes of policy and value (:class:`LayerNormMLP`).
        min_scale: smallest standard deviation of a stochastic policy, before the tanh.
        model: ``"gn"`` or ``"mlp"`` for a :class:`~torchrl_gn.policies.ObservationModel`, or None.
        model_options: options of that model.
        policy_options: options of a :class:`~torchrl_gn.policies.GraphPolicy`.
        learned_reward: make a :class:`~torchrl_gn.policies.LearnedReward`, too.

    Raises:
        ValueError: if ``policy`` is not known, or a graph policy is to be deterministic.
    """

    def __init__(
        self,
        graph: ObservationGraph,
        *,
        stochastic: bool = True,
        policy: Literal["mlp", "graph"] = "mlp",
        hidden: Sequence[int] = (256, 256),
        min_scale: float = 0.1,
        model: Literal["gn", "mlp"] | None = None,
        model_options: Mapping[str, Any] | None = None,
        policy_options: Mapping[str, Any] | None = None,
        learned_reward: bool = False,
    ) -> None:
        super().__init__()
        if policy not in ("mlp", "graph"):
            raise ValueError(f"policy={policy!r} is not known; use 'mlp' or 'graph'.")
        if policy == "graph" and not stochastic:
            raise ValueError("A graph policy is stochastic; use policy='mlp' for a deterministic one.")
        self.graph = graph
        self.options = {
            "stochastic": stochastic,
            "policy": policy,
            "hidden": list(hidden),
            "min_scale": min_scale,
            "model": model,
            "model_options": dict(model_options or {}),
            "policy_options": dict(policy_options or {}),
            "learned_reward": learned_reward,
        }
        observations, actions = graph.num_observations, graph.num_actions
        if stochastic:
            parameters: nn.Module
            if policy == "graph":
                parameters = GraphPolicy(graph, min_scale=min_scale, **(policy_options or {}))
            else:
                mlp = LayerNormMLP(observations, 2 * actions, hidden)
                parameters = nn.Sequential(mlp, NormalParamExtractor(scale_lb=cast(Any, min_scale)))
            self.policy = _actor(parameters)
        else:
            act = TensorDictModule(LayerNormMLP(observations, actions, hidden), ["observation"], ["action"])
            normalize = TensorDictModule(OutputNormalization(), ["action"], ["action"])
            self.policy = TensorDictSequential([act, normalize, TanhModule(in_keys=["action"])])
        self.value = ValueOperator(LayerNormMLP(observations + actions, 1, hidden), in_keys=["observation", "action"])
        self.model = None if model is None else ObservationModel(graph, core=model, **(model_options or {}))
        self.reward = LearnedReward(observations, actions, hidden) if learned_reward else None

    @property
    def graph_policy(self) -> GraphPolicy | None:
        """The graph network that chooses actions, or None."""
        return next((module for module in self.policy.modules() if isinstance(module, GraphPolicy)), None)

    def policy_for(self, graph: ObservationGraph) -> ProbabilisticActor:
        """Return the policy for another body, with shared weights.

        ValueError if the policy is not a graph network, or is tied to this body.
        """
        if self.graph_policy is None:
            raise ValueError("Only a graph network drives other bodies; build the agent with policy='graph'.")
        return _actor(self.graph_policy.for_graph(graph))

    @torch.no_grad()
    def update_normalizers(self, observation: Tensor, action: Tensor, next_observation: Tensor) -> None:
        """Add transitions ``[*B, O]``, ``[*B, A]``, ``[*B, O]`` to all statistics; ValueError if one is not finite."""
        with unchanged_on_error(self):
            if self.model is not None:
                self.model.update_normalizers(observation, action, next_observation)
            if self.graph_policy is not None:
                self.graph_policy.update_normalizers(observation)

    def description(self) -> dict:
        """Return JSON-able values from which :meth:`from_description` rebuilds the agent."""
        return {"graph": self.graph.description(), "options": self.options}

    @classmethod
    def from_description(cls, description: dict) -> Agent:
        """Build the agent of a :meth:`description`, with fresh weights."""
        return cls(ObservationGraph.from_description(description["graph"]), **description["options"])


def _actor(parameters: nn.Module) -> ProbabilisticActor:
    """Make a tanh-squashed Gaussian policy, with bounded location, from a module for its location and scale."""
    act = TensorDictModule(parameters, ["observation"], ["loc", "scale"])
    module = TensorDictSequential([act, TensorDictModule(OutputNormalization(), ["loc"], ["loc"])])
    return ProbabilisticActor(module, in_keys=["loc", "scale"], out_keys=["action"], distribution_class=TanhNormal)
