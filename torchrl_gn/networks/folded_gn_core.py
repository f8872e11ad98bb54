"""An exact :class:`~torchrl_gn.networks.GNCore` with fewer operations, for one scene.

Everything between two activations is linear, so for graphs of one scene

- the weight of an MLP's first layer is split by its inputs: nodes are projected once per node, globals once per graph,
  constants (static features, biases) once per batch;
- the linear last layer of an MLP commutes with the sum over edges and merges into the first layer of the next MLP;
- only nodes that move are predicted, from the edges that lead to them.

:func:`~torchrl_gn.networks.fold_gn_core.fold_gn_core` does this algebra on the weights. Items are the first dimension
and samples the second, ``[N, B, F]``, so that gathering and aggregating are products with small incidence matrices.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from torchrl_gn.networks.core import Columns
from torchrl_gn.networks.graph import Graph
from torchrl_gn.networks.incidence import Rows
from torchrl_gn.networks.layers import EDGES, NODES, Gather, LayerBuilder, LayerList
from torchrl_gn.networks.linear import linear, product

_CACHED = 2**20  # activations that fit a processor's cache


@dataclass(frozen=True)
class Factors:
    """The first layer of an MLP, split by its inputs, and the hidden layers after it."""

    weights: tuple[Tensor, ...]  # [h, F_k] for every input k
    table: Tensor  # [I, 1 or B, h], static features and biases
    hidden: tuple[tuple[Tensor, Tensor], ...]  # weight [h', h] and bias [h'] of each further layer


@dataclass(frozen=True)
class FoldedGNCore:
    """The folded weights of a core for one scene; made by :func:`fold_gn_core`."""

    ends: Tensor  # this and the next three: matrices of Incidence
    reduce: Tensor
    gather: Tensor
    reduce_last: Tensor
    kept: Rows  # edges that lead to a predicted node
    predicted: Rows  # predicted nodes
    first_edge: Factors  # inputs: both nodes and edge; globals
    first_node: Factors  # inputs: received edge hidden; node; globals
    first_global: Factors  # inputs: summed node hidden; summed edge hidden; globals
    second_edge: Factors  # inputs: first edge hidden; both nodes and edge
    second_ends: tuple[Tensor, Tensor]  # [h, h_n] twice: from hidden nodes as senders, as receivers
    second_globals: tuple[Tensor, Tensor]  # [h, h_g] and [h, F_g]: from hidden globals and globals to edges
    second_node: Factors  # inputs: received edge hidden; node; first node hidden
    last_globals: tuple[Tensor, Tensor]  # like second_globals, to nodes
    out: tuple[Tensor, Tensor]  # weight [F_out, h] and bias [F_out]
    activation: str

    def __call__(self, nodes: Tensor, edges: Tensor, globals_: Tensor) -> Tensor:
        """Predict nodes ``[P, B, F_out]`` from dynamic features ``[N, B, F_n]``, ``[E, B, F_e]``, ``[1, B, F_g]``."""
        count_n, count_e = nodes.shape[0], edges.shape[0]
        ends = torch.cat((*product(self.ends, nodes).split((count_e, count_e)), edges), dim=-1)
        everywhere = globals_.expand(count_e, -1, -1)

        edge_hidden = self._hidden(self.first_edge, (ends, everywhere))
        received, summed = product(self.reduce, edge_hidden).split((count_n, 1))
        everywhere = globals_.expand(count_n, -1, -1)
        node_hidden = self._hidden(self.first_node, (received, nodes, everywhere))
        summed = (node_hidden.sum(0, keepdim=True), summed, globals_)
        global_hidden = self._hidden(self.first_global, summed)

        # Project once per node and graph, then gather senders, receivers and graph by one product.
        projected = torch.cat(
            (
                *(linear(((node_hidden, weight),)) for weight in self.second_ends),
                linear(tuple(zip((global_hidden, globals_), self.second_globals, strict=True))),
            )
        )
        inputs = (edge_hidden[self.kept], ends[self.kept])
        edge_hidden = self._hidden(self.second_edge, inputs, self.gather, projected)
        received = product(self.reduce_last, edge_hidden)

        graph = linear(tuple(zip((global_hidden, globals_), self.last_globals, strict=True)))
        moving, moving_hidden = nodes[self.predicted], node_hidden[self.predicted]
        ones = graph.new_ones(len(received), 1)
        hidden = self._hidden(self.second_node, (received, moving, moving_hidden), ones, graph)
        weight, bias = self.out
        return F.linear(hidden, weight, bias)

    def _hidden(self, factors: Factors, inputs, matrix=None, items=None) -> Tensor:
        """Return the last hidden activation of an MLP, given the factors of its first layer."""
        pairs = tuple(zip(inputs, factors.weights, strict=True))
        hidden = linear(pairs, factors.table, matrix, items, self.activation)
        for weight, bias in factors.hidden:
            hidden = linear(((hidden, weight),), bias.expand(hidden.shape[0], 1, -1), activation=self.activation)
        return hidden

    def predict(self, dynamic: Graph) -> Tensor:
        """Return nodes ``[*B, N, F_out]``, zero if not predicted, for a normalised dynamic graph ``[*B, ...]``."""
        batch = dynamic.nodes.shape[:-2]
        inputs = (
            items_first(dynamic.nodes).contiguous(),
            items_first(dynamic.edges).contiguous(),
            items_first(dynamic.globals_.unsqueeze(-2)),
        )
        out = torch.cat([self(*part) for part in self._parts(inputs)], dim=1)
        full = out.new_zeros(dynamic.nodes.shape[-2], *out.shape[1:])
        full[self.predicted] = out
        return full.transpose(0, 1).reshape(*batch, *full.shape[::2])

    def layers(self) -> LayerList | None:
        """Return the network as a list of layers; None with dynamic globals."""
        if self.second_globals[1].shape[1]:
            return None
        count_n, count_e = self.reduce.shape[0] - 1, self.reduce.shape[1]
        width = self.first_node.weights[1].shape[1]
        device = self.reduce.device
        every_edge = torch.arange(count_e, device=device)
        kept, predicted = every_edge[self.kept], torch.arange(count_n, device=device)[self.predicted]
        senders, receivers = self.ends[:count_e], self.ends[count_e:]
        builder = LayerBuilder(self.activation)

        def mlp(factors: Factors, inputs: Sequence[Gather], added: Sequence[Gather] = ()) -> int:
            weight = torch.cat(factors.weights, 1)
            first = builder.add(inputs, weight, factors.table.squeeze(1), tuple(added), self.activation)
            return builder.hidden(first, factors.hidden)

        def ends(edges: Tensor) -> tuple[Gather, ...]:
            nodes = (Gather.sums(NODES, matrix[edges]) for matrix in (senders, receivers))
            return *nodes, Gather.picks(EDGES, edges)

        def graph(source: int, count: int) -> Gather:
            return Gather.picks(source, torch.zeros(count, dtype=torch.int64, device=device))

        everywhere = torch.arange(count_n, device=device)
        edge = mlp(self.first_edge, ends(every_edge))
        received = Gather.sums(edge, self.reduce[:-1])
        node = mlp(self.first_node, (received, Gather.picks(NODES, everywhere)))
        summed = Gather.sums(node, self.reduce.new_ones(1, count_n)), Gather.sums(edge, self.reduce[-1:])
        global_ = mlp(self.first_global, summed)

        projected = [builder.linear(node, everywhere, weight) for weight in self.second_ends]
        added = [Gather.sums(each, side[kept]) for each, side in zip(projected, (senders, receivers), strict=True)]
        first = torch.zeros(1, dtype=torch.int64, device=device)
        added.append(graph(builder.linear(global_, first, self.second_globals[0]), len(kept)))
        edge = mlp(self.second_edge, (Gather.picks(edge, kept), *ends(kept)), added)
        added = graph(builder.linear(global_, first, self.last_globals[0]), len(predicted))
        inputs = Gather.sums(edge, self.reduce_last), Gather.picks(NODES, predicted), Gather.picks(node, predicted)
        hidden = mlp(self.second_node, inputs, (added,))
        builder.linear(hidden, torch.arange(len(predicted), device=device), *self.out)
        edge_width = self.first_edge.weights[0].shape[1] - 2 * width
        return LayerList((count_n, width), (count_e, edge_width), tuple(builder.layers))

    def _parts(self, inputs: tuple[Tensor, ...]) -> list[tuple[Tensor, ...]]:
        """Split inputs ``[I, B, F]`` by samples on a CPU, so that the activations of a part fit its cache."""
        table = self.first_edge.table
        if inputs[0].device.type != "cpu" or torch.is_grad_enabled() or torch.compiler.is_compiling():
            return [inputs]
        if table.shape[1] > 1:  # each sample has its own table
            return [inputs]
        samples = max(1, _CACHED // max(1, table.shape[0] * table.shape[2]))  # the table is empty without edges
        return list(zip(*(part.split(samples, dim=1) for part in inputs), strict=True))

    def reduced(self, nodes: Columns, edges: Columns, out: Columns, shift: Tensor) -> FoldedGNCore:
        """Return this core with fewer, rescaled features; see :class:`~torchrl_gn.networks.core.ReducibleCore`."""
        n = self.first_node.weights[1].shape[1]
        node, edge = nodes[0], edges[0]
        ends = torch.cat((node, n + node, 2 * n + edge)), torch.cat((nodes[1], nodes[1], edges[1]))

        def change(factors: Factors, index: int, columns: Columns) -> Factors:
            weights = list(factors.weights)
            weights[index] = _columns(weights[index], columns)
            return replace(factors, weights=tuple(weights))

        weight, bias = self.out
        return replace(
            self,
            first_edge=change(self.first_edge, 0, ends),
            first_node=change(self.first_node, 1, nodes),
            second_edge=change(self.second_edge, 1, ends),
            second_node=change(self.second_node, 1, nodes),
            out=(_columns(weight.T, out).T, bias[out[0]] * out[1].to(bias.dtype) + shift.to(bias.dtype)),
        )


def _columns(weight: Tensor, columns: Columns) -> Tensor:
    index, factor = columns
    # index_select, because its gradient adds whole columns.
    return weight.index_select(1, index) * factor.to(weight.dtype)


def items_first(features: Tensor) -> Tensor:
    """Reshape ``[*B, I, F]`` to ``[I, 1 or B, F]``."""
    # math.prod and not numel(), which would fix the batch of an exported program.
    return features.reshape(math.prod(features.shape[:-2]), *features.shape[-2:]).transpose(0, 1)
