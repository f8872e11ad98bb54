"""Incidence matrices of the edges and nodes of a graph."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from torchrl_gn.maths.float64_buffers import Float64Buffers

Rows = Tensor | slice


class Incidence(Float64Buffers):
    """Small matrices of zeros and ones for the edges of one topology, and the nodes to predict.

    Folded cores multiply by these matrices to gather at edges and to sum at nodes.

    Args:
        edge_index: ``[2, E]`` senders above receivers.
        num_nodes: nodes of the graph.
        predicted: ``[P]`` indices of the nodes to predict, in any order; None: all.
    """

    edge_index: Tensor
    predicted: Tensor
    kept: Tensor  # [E'] edges that lead to a predicted node
    ends: Tensor  # [2 E, N], selects the senders of all edges, then their receivers
    reduce: Tensor  # [N + 1, E], sums edges at their receivers; the last row sums all edges
    degree: Tensor  # [N, 1, 1] edges that a node receives
    gather: Tensor  # [E', 2 N + 1], adds the sender's row (of the first N), the receiver's (of the next N), the last
    reduce_last: Tensor  # [P, E'], sums the kept edges at the predicted nodes

    def __init__(self, edge_index: Tensor, num_nodes: int, predicted: Tensor | None = None) -> None:
        super().__init__()
        self.num_nodes, self.num_edges = num_nodes, edge_index.shape[1]
        predicted = torch.arange(num_nodes, device=edge_index.device) if predicted is None else predicted
        kept = torch.isin(edge_index[1], predicted).nonzero().flatten()
        sender, receiver = (F.one_hot(index, num_nodes).float() for index in edge_index)
        ones = receiver.new_ones(self.num_edges, 1)
        reduce = torch.cat((receiver, ones), 1).T.contiguous()
        self._slices = _slice(predicted), _slice(kept)
        self.constants(
            {
                "edge_index": edge_index,
                "predicted": predicted,
                "kept": kept,
                "ends": torch.cat((sender, receiver)),
                "reduce": reduce,
                "degree": receiver.sum(0)[:, None, None],
                "gather": torch.cat((sender, receiver, ones), 1)[kept],
                "reduce_last": reduce[predicted][:, kept].contiguous(),
            }
        )

    @property
    def predicted_rows(self) -> Rows:
        """Predicted nodes, as a slice if they are consecutive."""
        return self.predicted if self._slices[0] is None else self._slices[0]

    @property
    def kept_rows(self) -> Rows:
        """Edges that lead to predicted nodes, as a slice if they are consecutive."""
        return self.kept if self._slices[1] is None else self._slices[1]


def _slice(index: Tensor) -> slice | None:
    """Return consecutive indices as a slice, which selects without a copy; None for other indices."""
    first, count = int(index[0]) if len(index) else 0, len(index)
    in_a_row = torch.arange(first, first + count, device=index.device)
    return slice(first, first + count) if torch.equal(index, in_a_row) else None
