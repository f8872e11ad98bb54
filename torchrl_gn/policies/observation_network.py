"""Graph networks over flat observations."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Literal, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_gn.finite import require_real
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.normalizer import Normalizer, unchanged_on_error
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.networks.core import UnfoldedCore, dtype_of
from torchrl_gn.networks.gn_core import GNCore
from torchrl_gn.networks.graph import Graph, GraphSize
from torchrl_gn.networks.incidence import Incidence
from torchrl_gn.networks.mlp_core import MLPCore
from torchrl_gn.scenes import ObservationGraph

M = TypeVar("M", bound=nn.Module)

_FLOOR = 1e-6  # standard deviations up to this are rounding noise of float32 observations


class ObservationNetwork(nn.Module):
    """Two GN blocks, or an MLP as baseline, from flat observations to features of every node.

    Reads normalised observations, arranged by the :class:`~torchrl_gn.scenes.ObservationGraph`, actions at the edges of
    their joints, the direction of edges (1 or -1), and one-hot nodes if the graph shows identities. Each call folds all
    constants (:func:`~torchrl_gn.networks.fold_gn_core.fold_gn_core`), differentiably in the weights.

    Args:
        graph: arrangement of observations and actions.
        out_nodes: number of output features of every node.
        actions: True to read actions.
        core: ``"gn"``, or ``"mlp"``, one MLP over the flattened graph.
        latent: number of features between the two GN blocks.
        hidden: hidden sizes of all MLPs of the GN blocks.
        plain: evaluate the core by message passing: the same function, but slower.
    """

    def __init__(
        self,
        graph: ObservationGraph,
        out_nodes: int,
        *,
        actions: bool,
        core: Literal["gn", "mlp"] = "gn",
        latent: int = 64,
        hidden: Sequence[int] = (64, 64),
        mlp_hidden: Sequence[int] = (256, 256),
        activation: str = "silu",
        plain: bool = False,
    ) -> None:
        super().__init__()
        self.actions, self.plain = actions, plain
        acting = graph.node_actions.shape[1] if actions else 0
        self.size = GraphSize(graph.num_node_features, graph.num_joint_features + acting, len(graph.global_entries))
        self.node_normalizer = Normalizer(self.size.nodes, floor=_FLOOR)
        self.edge_normalizer = Normalizer(self.size.edges, floor=_FLOOR)
        self.global_normalizer = Normalizer(self.size.globals_, floor=_FLOOR)
        static = GraphSize(graph.num_nodes if graph.identity else 0, 1, 0)
        self.core: GNCore | MLPCore
        if core == "gn":
            self.core = GNCore(self.size, static, out_nodes, latent=latent, activation=activation, hidden=hidden)
        elif core == "mlp":
            counts = graph.num_nodes, graph.num_edges
            self.core = MLPCore(self.size, static, out_nodes, counts=counts, hidden=mlp_hidden, activation=activation)
        else:
            raise ValueError(f"core={core!r} is not known; use 'gn' or 'mlp'.")
        self.graph, self.places = graph, _Places(graph)

    def for_graph(self, graph: ObservationGraph) -> ObservationNetwork:
        """Return the network for another graph, with shared weights.

        ValueError if the graph has other features, or if identities or an MLP tie the network to its own graph.
        """
        widths, other_widths = _widths(self.graph), _widths(graph)
        if widths != other_widths:
            raise ValueError(f"The network reads {widths} features, graph {graph.name!r} has {other_widths}.")
        if graph.identity != self.graph.identity:
            raise ValueError(f"The network and graph {graph.name!r} must both show identities, or neither.")
        sizes = [(each.num_nodes, each.num_edges // 2) for each in (self.graph, graph)]
        if sizes[0] != sizes[1] and (self.graph.identity or isinstance(self.core, MLPCore)):
            raise ValueError(
                f"The network is tied to graphs of {sizes[0][0]} nodes and {sizes[0][1]} joints, {graph.name!r} has"
                f" {sizes[1][0]} and {sizes[1][1]}. Use core='gn' and a graph without identity."
            )
        network = sharing_weights(self)
        network.graph, network.places = graph, _Places(graph).to(self.places.slots.device)
        return network

    @property
    def fitted(self) -> bool:
        """True if the normalisers have data; reading it synchronises with the device."""
        return all(
            normalizer.fitted for normalizer in (self.node_normalizer, self.edge_normalizer, self.global_normalizer)
        )

    @torch.no_grad()
    def update_normalizers(self, observation: Tensor, action: Tensor | None = None) -> None:
        """Add observations ``[*B, O]`` and actions ``[*B, A]``; ValueError if misshapen or not finite."""
        nodes, edges, globals_ = self._arrange(observation, action)
        with unchanged_on_error(self):
            self.node_normalizer.update(nodes, self.places.node_mask)
            self.edge_normalizer.update(edges, self.places.edge_mask[:, : edges.shape[-1]])
            self.global_normalizer.update(globals_)

    def _arrange(self, observation: Tensor, action: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Return features of nodes, edges and globals; ValueError if the inputs do not fit the graph."""
        graph = self.graph
        require_real(observation, "The observation", whole=False)
        if self.actions and action is not None:
            require_real(action, "The action")
        if observation.shape[-1] != graph.num_observations:
            raise ValueError(
                f"Observations of {graph.name!r} must be [*B, {graph.num_observations}], got {list(observation.shape)}."
            )
        if self.actions and (action is None or action.shape != (*observation.shape[:-1], graph.num_actions)):
            raise ValueError(
                f"Actions of {graph.name!r} must be {[*observation.shape[:-1], graph.num_actions]} to go with"
                f" observations {list(observation.shape)}, got {None if action is None else list(action.shape)}."
            )
        return self.places.arrange(observation, action if self.actions else None)

    def dynamic_graph(self, observation: Tensor, action: Tensor | None = None) -> Graph:
        """Return the normalised graph ``[*B, ...]`` of observations ``[*B, O]`` and actions ``[*B, A]``."""
        dtype = dtype_of(self.core)
        nodes, edges, globals_ = self._arrange(observation, action)
        nodes = self.node_normalizer(nodes, dtype) * self.places.node_mask
        edges = self.edge_normalizer(edges, dtype) * self.places.edge_mask[:, : edges.shape[-1]]
        return Graph(nodes, edges, self.global_normalizer(globals_, dtype), self.places.incidence.edge_index)

    def static_graph(self) -> Graph:
        """Return directions of edges and identities of nodes, equal for every sample."""
        count, like = self.graph.num_nodes, {"dtype": dtype_of(self.core), "device": self.places.slots.device}
        nodes = torch.eye(count, **like)[:, : count if self.graph.identity else 0]
        direction = torch.tensor([1.0, -1.0], **like).repeat(self.graph.num_edges // 2).unsqueeze(-1)
        return Graph(nodes, direction, torch.zeros(0, **like), self.places.incidence.edge_index)

    @without_autocast
    def forward(self, observation: Tensor, action: Tensor | None = None) -> Tensor:
        """Return features ``[*B, N, out_nodes]`` from observations ``[*B, O]`` and, if read, actions ``[*B, A]``."""
        dynamic, static = self.dynamic_graph(observation, action), self.static_graph()
        folded = UnfoldedCore(self.core, static) if self.plain else self.core.fold(self.places.incidence, static)
        return folded.predict(dynamic)


def sharing_weights(module: M) -> M:
    """Copy a module; the copy shares weights and statistics, and its parts can be replaced."""
    twin = copy.copy(module)
    twin._modules, twin._buffers = dict(module._modules), dict(module._buffers)
    return twin


def _widths(graph: ObservationGraph) -> tuple[int, int, int, int]:
    acting = graph.node_actions.shape[1]
    return graph.num_node_features, graph.num_joint_features, acting, len(graph.global_entries)


class _Places(Float64Buffers):
    """Index tables that arrange observations and actions on one observation graph."""

    slots: Tensor  # [N, F_n + F_j] index in the observation, or the observation's length as padding
    mask: Tensor  # bool like slots, False for padding
    actions: Tensor
    globals_: Tensor
    moved: Tensor
    node_mask: Tensor
    edge_mask: Tensor

    def __init__(self, graph: ObservationGraph) -> None:
        super().__init__()
        slots, actions, self.split = graph.node_entries, graph.node_actions, graph.num_node_features
        moved = graph.moved.repeat(2)
        filled = slots >= 0
        self.incidence = Incidence(torch.as_tensor(graph.edge_index), graph.num_nodes)
        self.constants(
            {
                "slots": torch.as_tensor(slots) % (graph.num_observations + 1),
                "mask": filled,
                "actions": torch.as_tensor(actions) % (graph.num_actions + 1),
                "globals_": graph.global_entries,
                "moved": moved,
                "node_mask": filled[:, : self.split],
                "edge_mask": np.concatenate((filled[moved, self.split :], actions[moved] >= 0), axis=1),
            }
        )

    def arrange(self, observation: Tensor, action: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Return node ``[*B, N, F_n]``, edge ``[*B, E, F_j + C]`` and global features ``[*B, F_g]``; padding is 0."""
        slots = F.pad(observation, (0, 1))[..., self.slots]
        edges = slots[..., self.moved, self.split :]
        if action is not None:
            at_joints = F.pad(action, (0, 1))[..., self.actions[self.moved]]
            edges = torch.cat((edges, at_joints.to(edges.dtype)), dim=-1)
        return slots[..., : self.split], edges, observation[..., self.globals_]
