"""A batch of graphs of one topology, as plain tensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Tensor


@dataclass(frozen=True)
class GraphSize:
    """Numbers of features of a graph's nodes, edges and globals."""

    nodes: int
    edges: int
    globals_: int

    def __add__(self, other: GraphSize) -> GraphSize:
        return GraphSize(self.nodes + other.nodes, self.edges + other.edges, self.globals_ + other.globals_)


@dataclass(frozen=True)
class Graph:
    """Graphs ``G = (g, {n_i}, {e_j, s_j, r_j})`` that share one topology (paper, "Model")."""

    nodes: Tensor  # [*B, N, F_n]
    edges: Tensor  # [*B, E, F_e]
    globals_: Tensor  # [*B, F_g]
    edge_index: Tensor  # [2, E] int64, senders above receivers, as in PyG

    @property
    def features(self) -> tuple[Tensor, Tensor, Tensor]:
        """Features of nodes, edges and globals."""
        return self.nodes, self.edges, self.globals_

    def tensordict(self) -> TensorDict:
        """Return the features as entries of a TensorDict ``[*B]``."""
        features = {"nodes": self.nodes, "edges": self.edges, "globals_": self.globals_}
        return TensorDict(features, batch_size=self.globals_.shape[:-1])

    def zeros(self, size: GraphSize) -> Graph:
        """Return a graph of the same topology and batch whose features are all 0."""
        counts = size.nodes, size.edges, size.globals_
        zeros = [part.new_zeros(*part.shape[:-1], n) for part, n in zip(self.features, counts, strict=True)]
        return Graph(*zeros, edge_index=self.edge_index)

    def detach(self) -> Graph:
        """Return the graph detached from gradients."""
        return Graph(*(part.detach() for part in self.features), edge_index=self.edge_index)


def graph_concat(first: Graph, second: Graph) -> Graph:
    """Concatenate the features of two graphs of one topology, whose batches broadcast. Paper: "graph-concatenation"."""
    parts = zip(first.features, second.features, (2, 2, 1), strict=True)
    return Graph(*[_concat(a, b, trailing) for a, b, trailing in parts], edge_index=first.edge_index)


def graph_split(graph: Graph, sizes: Sequence[int]) -> tuple[Graph, Graph]:
    """Split off the first ``sizes`` = ``(F_n, F_e, F_g)`` features from the rest. Paper: "graph-splitting"."""
    n, e, g = sizes
    nodes, edges, globals_ = graph.features
    first = Graph(nodes[..., :n], edges[..., :e], globals_[..., :g], graph.edge_index)
    return first, Graph(nodes[..., n:], edges[..., e:], globals_[..., g:], graph.edge_index)


def _concat(first: Tensor, second: Tensor, trailing: int) -> Tensor:
    batch = torch.broadcast_shapes(first.shape[:-trailing], second.shape[:-trailing])
    return torch.cat([part.expand(*batch, *part.shape[-trailing:]) for part in (first, second)], dim=-1)
