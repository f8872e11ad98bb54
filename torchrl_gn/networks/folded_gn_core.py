"""The core's function computed with fewer operations, exactly, for one scene.

Between two activations everything is linear, so for a batch of graphs of one scene

- a first layer's weight is split by its inputs: nodes are projected once a node, globals
  once a graph, and what is the same for every sample (static features, biases) once a batch;
- an MLP's linear last layer commutes with the sum over edges and merges into the
  next first layer: hidden activations are aggregated and multiplied once a node or graph,
  and its bias becomes in-degree times bias;
- only nodes that move are predicted, from edges that lead to them.

:func:`fold_core` does this algebra on the weights of a :class:`~torchrl_gn.networks.GNCore`
and gives a :class:`FoldedCore`, which only multiplies. Training folds at every step, under
autograd, and gradients reach the core's weights as they do there; a specialised model
(:mod:`~torchrl_gn.dynamics.specialized`) folds once.

Items lie first and samples second, ``[N, B, F]``, so that gathering and aggregating are
products with small incidence matrices, and everything is matrix multiplication.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_gn.networks.graph import Graph, GraphSize
from torchrl_gn.networks.incidence import Incidence, Rows
from torchrl_gn.networks.linear import linear, product

if TYPE_CHECKING:
    from torchrl_gn.networks.gn_core import GNCore

_CACHED = 2**20  # numbers

Columns = tuple[Tensor, Tensor]  # indices, and factors on what is there


@dataclass(frozen=True)
class Factors:
    """First layer of an MLP by its inputs, and the hidden layers after it.

    Attributes:
        weights: ``[h, F_k]`` for every input ``k``.
        table: ``[I, 1, h]``, what every sample has in common; ``[I, B, h]`` with static features
            of their own for every sample.
        hidden: weight ``[h', h]`` and bias ``[h']`` of each further hidden layer.
    """

    weights: tuple[Tensor, ...]
    table: Tensor
    hidden: tuple[tuple[Tensor, Tensor], ...]


@dataclass(frozen=True)
class FoldedCore:
    """A core for one scene, ready to be multiplied; made by :func:`fold_core`.

    Attributes:
        ends, reduce, gather, reduce_last: matrices of the :class:`~torchrl_gn.networks.incidence.Incidence`.
        kept: edges that lead to a predicted node.
        predicted: nodes that are predicted.
        first_edge: inputs: ends and edge, globals.
        first_node: inputs: received hidden, node, globals.
        first_global: inputs: summed node hidden, summed edge hidden, globals.
        second_edge: inputs: first edge hidden, ends and edge.
        second_ends: ``[h, h_n]`` twice: node hidden as sender and as receiver.
        second_globals: ``[h, h_g]`` and ``[h, F_g]``: global hidden and globals, into edges.
        second_node: inputs: received hidden, node, first node hidden.
        last_globals: as ``second_globals``, into nodes.
        out: weight ``[F_out, h]`` and bias ``[F_out]``.
        activation: after every hidden layer.
    """

    ends: Tensor
    reduce: Tensor
    gather: Tensor
    reduce_last: Tensor
    kept: Rows
    predicted: Rows
    first_edge: Factors
    first_node: Factors
    first_global: Factors
    second_edge: Factors
    second_ends: tuple[Tensor, Tensor]
    second_globals: tuple[Tensor, Tensor]
    second_node: Factors
    last_globals: tuple[Tensor, Tensor]
    out: tuple[Tensor, Tensor]
    activation: str

    def __call__(self, nodes: Tensor, edges: Tensor, globals_: Tensor) -> Tensor:
        """Output of the predicted nodes.

        Args:
            nodes: ``[N, B, F_n]`` normalised dynamic features.
            edges: ``[E, B, F_e]``.
            globals_: ``[1, B, F_g]``.

        Returns:
            ``[P, B, F_out]``.
        """
        count_n, count_e = nodes.shape[0], edges.shape[0]
        ends = torch.cat((*product(self.ends, nodes).split((count_e, count_e)), edges), dim=-1)
        everywhere = globals_.expand(count_e, -1, -1)

        edge_hidden = self._hidden(self.first_edge, (ends, everywhere))
        received, summed = product(self.reduce, edge_hidden).split((count_n, 1))
        everywhere = globals_.expand(count_n, -1, -1)
        node_hidden = self._hidden(self.first_node, (received, nodes, everywhere))
        summed = (node_hidden.sum(0, keepdim=True), summed, globals_)
        global_hidden = self._hidden(self.first_global, summed)

        # Projected once a node or graph, then gathered by one product: senders, receivers, graph.
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
        """Last hidden activation of an MLP whose first layer is given by its factors."""
        pairs = tuple(zip(inputs, factors.weights, strict=True))
        hidden = linear(pairs, factors.table, matrix, items, self.activation)
        for weight, bias in factors.hidden:
            table = bias.expand(hidden.shape[0], 1, -1)
            hidden = linear(((hidden, weight),), table, activation=self.activation)
        return hidden

    def predict(self, dynamic: Graph) -> Tensor:
        """Output nodes ``[*B, N, F_out]`` of a normalised dynamic graph ``[*B, ...]``, zero if not predicted."""
        batch = dynamic.nodes.shape[:-2]
        inputs = (
            _items(dynamic.nodes).contiguous(),
            _items(dynamic.edges).contiguous(),
            _items(dynamic.globals_.unsqueeze(-2)),
        )
        out = torch.cat([self(*part) for part in self._parts(inputs)], dim=1)
        full = out.new_zeros(dynamic.nodes.shape[-2], *out.shape[1:])
        full[self.predicted] = out
        return full.transpose(0, 1).reshape(*batch, *full.shape[::2])

    def _parts(self, inputs: tuple[Tensor, ...]) -> list[tuple[Tensor, ...]]:
        """Inputs ``[I, B, F]``, on a processor in parts of as many samples as its cache holds activations of."""
        table = self.first_edge.table
        if inputs[0].device.type != "cpu" or torch.is_grad_enabled() or torch.compiler.is_compiling():
            return [inputs]
        if table.shape[1] > 1:  # every sample has its own
            return [inputs]
        samples = max(1, _CACHED // (table.shape[0] * table.shape[2]))
        return list(zip(*(part.split(samples, dim=1) for part in inputs), strict=True))

    def reduced(self, nodes: Columns, edges: Columns, out: Columns, shift: Tensor) -> FoldedCore:
        """This core with fewer and rescaled features (with ``F_n`` and ``F_e`` those that are left).

        Args:
            nodes: columns of the nodes' dynamic features that are kept, and factors on them.
            edges: the same for edges.
            out: rows of the output that are kept, and factors on them.
            shift: added to the scaled output.
        """
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
            out=(_columns(weight.T, out).T, bias[out[0]] * out[1] + shift),
        )


def fold_core(core: GNCore, size: GraphSize, incidence: Incidence, static: Graph) -> FoldedCore:
    """Fold a core for graphs of one topology.

    Args:
        core: the two GN blocks.
        size: features of the dynamic graphs; the rest of the core's input is static.
        incidence: of the graphs, and which of their nodes are predicted.
        static: normalised static graph; any part may have a leading batch, which is then that
            of the dynamic graphs.

    Returns:
        The folded core: differentiable in the core's weights and the static graph.
    """
    n, e, g = size.nodes, size.edges, size.globals_
    sn, se, sg = static.nodes.shape[-1], static.edges.shape[-1], static.globals_.shape[-1]
    first, second = core.first, core.second
    num_nodes, num_edges = incidence.num_nodes, incidence.num_edges
    kept, rows = incidence.kept_rows, incidence.predicted_rows
    dtype = _first_layer(first.edge_mlp)[0].dtype
    degree = incidence.degree.to(dtype)

    static_nodes, static_globals = _items(static.nodes), _items(static.globals_.unsqueeze(-2))
    sides = (*(static_nodes[ends] for ends in incidence.edge_index), _items(static.edges))
    static_edges = torch.cat(_broadcast(sides), dim=-1)

    # First block. Weight columns: globals, sender, receiver, edge; each dynamic then static.
    weight, bias = _first_layer(first.edge_mlp)
    wg, wsg, ws, wss, wr, wsr, we, wse = weight.split((g, sg, n, sn, n, sn, e, se), dim=1)
    table = bias + F.linear(static_edges, torch.cat((wss, wsr, wse), 1)) + F.linear(static_globals, wsg)
    first_edge = _factors(first.edge_mlp, (torch.cat((ws, wr, we), 1), wg), table)
    edge_out, edge_bias = _last_layer(first.edge_mlp)

    weight, bias = _first_layer(first.node_mlp)
    wg, wsg, wn, wsn, wa = weight.split((g, sg, n, sn, edge_out.shape[0]), dim=1)
    table = bias + F.linear(static_nodes, wsn) + F.linear(static_globals, wsg) + degree * (wa @ edge_bias)
    first_node = _factors(first.node_mlp, (wa @ edge_out, wn, wg), table)
    node_out, node_bias = _last_layer(first.node_mlp)

    weight, bias = _first_layer(first.global_mlp)
    wg, wsg, wn, we = weight.split((g, sg, node_out.shape[0], edge_out.shape[0]), dim=1)
    if first.pool == "mean":
        wn, we = wn / num_nodes, we / max(num_edges, 1)
    table = bias + F.linear(static_globals, wsg) + num_nodes * (wn @ node_bias) + num_edges * (we @ edge_bias)
    first_global = _factors(first.global_mlp, (wn @ node_out, we @ edge_out, wg), table)
    global_out, global_bias = _last_layer(first.global_mlp)

    # Second block: its input is the first block's input and output side by side.
    latent_g, latent_n, latent_e = global_out.shape[0], node_out.shape[0], edge_out.shape[0]
    weight, bias = _first_layer(second.edge_mlp)
    wg, wsg, wlg, ws, wss, wls, wr, wsr, wlr, we, wse, wle = weight.split(
        (g, sg, latent_g, n, sn, latent_n, n, sn, latent_n, e, se, latent_e), dim=1
    )
    table = bias + F.linear(static_edges, torch.cat((wss, wsr, wse), 1)) + F.linear(static_globals, wsg)
    table = table + wlg @ global_bias + (wls + wlr) @ node_bias + wle @ edge_bias
    second_edge = _factors(
        second.edge_mlp,
        (wle @ edge_out, torch.cat((ws, wr, we), 1)),
        table[kept],
    )
    second_ends, second_globals = (wls @ node_out, wlr @ node_out), (wlg @ global_out, wg)
    edge_out, edge_bias = _last_layer(second.edge_mlp)

    weight, bias = _first_layer(second.node_mlp)
    wg, wsg, wlg, wn, wsn, wln, wa = weight.split((g, sg, latent_g, n, sn, latent_n, edge_out.shape[0]), dim=1)
    table = bias + F.linear(static_nodes, wsn) + F.linear(static_globals, wsg) + degree * (wa @ edge_bias)
    table = (table + wlg @ global_bias + wln @ node_bias)[rows]
    return FoldedCore(
        ends=incidence.ends.to(dtype),
        reduce=incidence.reduce.to(dtype),
        gather=incidence.gather.to(dtype),
        reduce_last=incidence.reduce_last.to(dtype),
        kept=kept,
        predicted=rows,
        first_edge=first_edge,
        first_node=first_node,
        first_global=first_global,
        second_edge=second_edge,
        second_ends=second_ends,
        second_globals=second_globals,
        second_node=_factors(second.node_mlp, (wa @ edge_out, wn, wln @ node_out), table),
        last_globals=(wlg @ global_out, wg),
        out=_last_layer(second.node_mlp),
        activation=core.activation,
    )


def _factors(mlp: nn.Sequential | None, weights: tuple[Tensor, ...], table: Tensor) -> Factors:
    assert mlp is not None
    hidden = [layer for layer in list(mlp)[2:-1:2] if isinstance(layer, nn.Linear)]
    return Factors(weights, table, tuple((layer.weight, layer.bias) for layer in hidden))


def _columns(weight: Tensor, columns: Columns) -> Tensor:
    index, factor = columns
    return weight[:, index] * factor


def _map(value: Any, function: Callable[[Tensor], Tensor]) -> Any:
    """The same nested tuples and dataclasses with ``function`` on every floating-point tensor."""
    if isinstance(value, Tensor):
        return function(value) if value.is_floating_point() else value
    if isinstance(value, tuple):
        return tuple(_map(entry, function) for entry in value)
    if is_dataclass(value) and not isinstance(value, type):
        changed = {field.name: _map(getattr(value, field.name), function) for field in fields(value)}
        return replace(value, **changed)
    return value


def snapshot(folded: Any, dtype: torch.dtype) -> Any:
    """Copy of a folded network that shares no memory and passes no gradient to the weights."""
    return _map(folded, lambda tensor: tensor.detach().to(dtype).clone(memory_format=torch.contiguous_format))


def copy_into(old, new) -> bool:
    """Overwrite the tensors of nested tuples and dataclasses, if all else is equal; whether it was."""
    pairs: list[tuple[Tensor, Tensor]] = []

    def collect(a, b) -> bool:
        if type(a) is not type(b):
            return False
        if isinstance(a, Tensor):
            pairs.append((a, b))
            return (a.shape, a.dtype, a.device) == (b.shape, b.dtype, b.device)
        if isinstance(a, tuple):
            return len(a) == len(b) and all(map(collect, a, b))
        if is_dataclass(a):
            return all(collect(getattr(a, field.name), getattr(b, field.name)) for field in fields(a))
        return a == b

    if not collect(old, new):
        return False
    with torch.no_grad():
        for a, b in pairs:
            a.copy_(b)
    return True


def _items(features: Tensor) -> Tensor:
    """``[*B, I, F]`` as ``[I, 1 or B, F]``."""
    # math.prod, not numel(): an exported program is for any batch.
    return features.reshape(math.prod(features.shape[:-2]), *features.shape[-2:]).transpose(0, 1)


def _broadcast(parts) -> list[Tensor]:
    """Give all parts ``[I, 1 or B, F]`` the larger batch."""
    (batch,) = torch.broadcast_shapes(*(part.shape[1:2] for part in parts))
    return [part.expand(-1, batch, -1) for part in parts]


def _first_layer(mlp: nn.Sequential | None) -> tuple[Tensor, Tensor]:
    assert mlp is not None
    layer = mlp[0]
    assert isinstance(layer, nn.Linear)
    return layer.weight, layer.bias


def _last_layer(mlp: nn.Sequential | None) -> tuple[Tensor, Tensor]:
    assert mlp is not None
    layer = mlp[-1]
    assert isinstance(layer, nn.Linear)
    return layer.weight, layer.bias
