"""The core's function computed with fewer operations, exactly, for one scene.

Between two ReLUs everything is linear, so for a batch of graphs of one scene

- a first layer's weight is split by its inputs: nodes are projected once a node, globals
  once a graph, and what is the same for every sample (static features, biases) once a batch;
- an MLP's linear last layer commutes with the sum over edges and merges into the
  next first layer: hidden activations are aggregated and multiplied once a node or graph,
  and its bias becomes in-degree times bias;
- only nodes that move are predicted.

The weights stay those of the :class:`~torchrl_gn.modules.GNCore`; gradients reach them as
they do there. Items lie first and samples second, ``[N, B, F]``, so that gathering and
aggregating are products with small incidence matrices, and everything is matrix
multiplication. A layer with several inputs is one autograd function (:class:`_Layer`) that
accumulates into one buffer: on a CPU the passes over memory between the products would
cost as much as the products.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_gn.modules.core import GNCore
from torchrl_gn.modules.graph import Graph


def factorized_core(core: GNCore, dynamic: Graph, static: Graph, predicted: Tensor) -> Tensor:
    """Output nodes of ``core(graph_concat(dynamic, static))``, computed by factors.

    Args:
        core: the two GN blocks.
        dynamic: ``[*B, ...]`` normalised dynamic graph.
        static: normalised static graph without batch; parts may have no columns.
        predicted: ``[P]`` indices of the nodes to predict.

    Returns:
        ``[*B, N, F_out]``; zero for nodes that are not predicted. Differentiable once in
        the dynamic graph and the weights.
    """
    batch = dynamic.nodes.shape[:-2]
    senders, receivers = dynamic.edge_index
    nodes, edges = _items_first(dynamic.nodes), _items_first(dynamic.edges)
    globals_ = dynamic.globals_.reshape(1, batch.numel(), dynamic.globals_.shape[-1])
    num_nodes, num_edges = nodes.shape[0], edges.shape[0]
    gather, reduce = _incidence(dynamic.edge_index, num_nodes, nodes.dtype)
    degree = reduce[:num_nodes].sum(1, keepdim=True)

    static_edges = torch.cat((static.nodes[senders], static.nodes[receivers], static.edges), dim=-1)
    n, e, g = nodes.shape[-1], edges.shape[-1], globals_.shape[-1]
    sn, se, sg = static.nodes.shape[-1], static.edges.shape[-1], static.globals_.shape[-1]
    first, second = core.first, core.second
    dynamic_edges = torch.cat((nodes[senders], nodes[receivers], edges), dim=-1)  # [E, B, 2 F_n + F_e]

    # First block. Weight columns: globals, sender, receiver, edge; each dynamic then static.
    weight, bias = _first_layer(first.edge_mlp)
    wg, wsg, ws, wss, wr, wsr, we, wse = weight.split((g, sg, n, sn, n, sn, e, se), dim=1)
    table = bias + F.linear(static_edges, torch.cat((wss, wsr, wse), 1)) + F.linear(static.globals_, wsg)
    pairs = [(dynamic_edges, torch.cat((ws, wr, we), 1)), (globals_.expand(num_edges, -1, -1), wg)]
    edge_hidden = _hidden(first.edge_mlp, pairs, table)  # [E, B, h]
    edge_out, edge_bias = _last_layer(first.edge_mlp)
    reduced = _product(reduce, edge_hidden)  # received by each node, then the sum over all edges

    weight, bias = _first_layer(first.node_mlp)
    wg, wsg, wn, wsn, wa = weight.split((g, sg, n, sn, edge_out.shape[0]), dim=1)
    table = bias + F.linear(static.nodes, wsn) + F.linear(static.globals_, wsg) + degree * (wa @ edge_bias)
    pairs = [(reduced[:num_nodes], wa @ edge_out), (nodes, wn), (globals_.expand(num_nodes, -1, -1), wg)]
    node_hidden = _hidden(first.node_mlp, pairs, table)  # [N, B, h]
    node_out, node_bias = _last_layer(first.node_mlp)

    assert first.global_mlp is not None
    weight, bias = _first_layer(first.global_mlp)
    wg, wsg, wn, we = weight.split((g, sg, node_out.shape[0], edge_out.shape[0]), dim=1)
    table = bias + F.linear(static.globals_, wsg) + num_nodes * (wn @ node_bias) + num_edges * (we @ edge_bias)
    pairs = [
        (node_hidden.sum(0, keepdim=True), wn @ node_out),
        (reduced[num_nodes:], we @ edge_out),
        (globals_, wg),
    ]
    global_hidden = _hidden(first.global_mlp, pairs, table[None])  # [1, B, h]
    global_out, global_bias = _last_layer(first.global_mlp)

    # Second block: its input is the first block's input and output side by side.
    latent_g, latent_n, latent_e = global_out.shape[0], node_out.shape[0], edge_out.shape[0]
    weight, bias = _first_layer(second.edge_mlp)
    wg, wsg, wlg, ws, wss, wls, wr, wsr, wlr, we, wse, wle = weight.split(
        (g, sg, latent_g, n, sn, latent_n, n, sn, latent_n, e, se, latent_e), dim=1
    )
    table = bias + F.linear(static_edges, torch.cat((wss, wsr, wse), 1)) + F.linear(static.globals_, wsg)
    table = table + wlg @ global_bias + (wls + wlr) @ node_bias + wle @ edge_bias
    # Projected once a node or graph, then gathered by one product: senders, receivers, graph.
    projected = torch.cat(
        (
            _linear([(node_hidden, wls @ node_out)]),
            _linear([(node_hidden, wlr @ node_out)]),
            _linear([(global_hidden, wlg @ global_out), (globals_, wg)]),
        )
    )
    pairs = [(edge_hidden, wle @ edge_out), (dynamic_edges, torch.cat((ws, wr, we), 1))]
    edge_hidden = _hidden(second.edge_mlp, pairs, table, (gather, projected))
    edge_out, edge_bias = _last_layer(second.edge_mlp)
    received = _product(reduce[predicted], edge_hidden)  # [P, B, h]

    weight, bias = _first_layer(second.node_mlp)
    wg, wsg, wlg, wn, wsn, wln, wa = weight.split((g, sg, latent_g, n, sn, latent_n, edge_out.shape[0]), dim=1)
    table = bias + F.linear(static.nodes, wsn) + F.linear(static.globals_, wsg) + degree * (wa @ edge_bias)
    table = (table + wlg @ global_bias + wln @ node_bias)[predicted]
    per_graph = _linear([(global_hidden, wlg @ global_out), (globals_, wg)])
    pairs = [(received, wa @ edge_out), (nodes[predicted], wn), (node_hidden[predicted], wln @ node_out)]
    hidden = _hidden(second.node_mlp, pairs, table, (per_graph.new_ones(len(predicted), 1), per_graph))
    weight, bias = _last_layer(second.node_mlp)
    out = F.linear(hidden, weight, bias)  # [P, B, F_out]
    full = out.new_zeros(num_nodes, *out.shape[1:]).index_copy(0, predicted, out)
    return full.transpose(0, 1).reshape(*batch, num_nodes, out.shape[-1])


class _Layer(torch.autograd.Function):
    """``relu(table + matrix @ items + sum_k x_k @ W_k.T)``, accumulated in one buffer.

    Inputs: ``relu`` flag, ``table`` ``[I, h]`` or None, ``matrix`` ``[I, J]`` and ``items``
    ``[J, B, h]`` or None, then pairs ``x_k`` ``[I, B, F_k]`` and ``W_k`` ``[h, F_k]``.
    Output ``[I, B, h]``.
    """

    @staticmethod
    def forward(ctx, relu, table, matrix, items, *pairs):
        features, weights = pairs[::2], pairs[1::2]
        count, batch = features[0].shape[:2]
        flat = [x.reshape(count * batch, x.shape[-1]) for x in features]
        start = 0
        if items is None:
            out = flat[0] @ weights[0].T
            start = 1
        else:
            out = (matrix @ items.flatten(1)).view(count * batch, items.shape[-1])
        for x, weight in zip(flat[start:], weights[start:], strict=True):
            out.addmm_(x, weight.T)
        shaped = out.view(count, batch, out.shape[-1])
        if table is not None:
            shaped.add_(table[:, None])
        if relu:
            out.relu_()
        ctx.relu, ctx.has_table = relu, table is not None
        ctx.save_for_backward(shaped if relu else None, matrix, *flat, *weights)
        return shaped

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        out, matrix, *saved = ctx.saved_tensors
        half = len(saved) // 2
        if ctx.relu:
            grad = torch.ops.aten.threshold_backward(grad, out, 0)
        count, batch, size = grad.shape
        flat_grad = grad.reshape(count * batch, size)
        needs = ctx.needs_input_grad
        table = flat_grad.view(count, batch, size).sum(1) if ctx.has_table and needs[1] else None
        items = None
        if matrix is not None and needs[3]:
            items = (matrix.T @ flat_grad.view(count, batch * size)).view(matrix.shape[1], batch, size)
        pairs = []
        for index, (x, weight) in enumerate(zip(saved[:half], saved[half:], strict=True)):
            pairs.append((flat_grad @ weight).view(count, batch, x.shape[-1]) if needs[4 + 2 * index] else None)
            pairs.append(flat_grad.T @ x if needs[5 + 2 * index] else None)
        return None, table, None, items, *pairs


def _linear(pairs, table=None, gathered=(None, None), relu: bool = False) -> Tensor:
    used = [tensor for pair in pairs if pair[0].shape[-1] for tensor in pair]
    return _Layer.apply(relu, table, *gathered, *used)


def _hidden(mlp: nn.Sequential, pairs, table: Tensor, gathered=(None, None)) -> Tensor:
    """Last hidden activation of an MLP whose first layer is given by its factors."""
    hidden = _linear(pairs, table, gathered, relu=True)
    for layer in list(mlp)[2:-1:2]:
        assert isinstance(layer, nn.Linear)
        hidden = _linear([(hidden, layer.weight)], layer.bias.expand(hidden.shape[0], -1), relu=True)
    return hidden


def _incidence(edge_index: Tensor, num_nodes: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Dense maps between items.

    ``gather`` ``[E, 2 N + 1]`` adds, for every edge, its sender's row of the first ``N``,
    its receiver's row of the next ``N`` and the graph's row. ``reduce`` ``[N + 1, E]`` sums
    edges at their receivers, and all of them in its last row.
    """
    sender, receiver = (F.one_hot(index, num_nodes).to(dtype) for index in edge_index)
    ones = torch.ones(edge_index.shape[1], 1, dtype=dtype, device=edge_index.device)
    return torch.cat((sender, receiver, ones), 1), torch.cat((receiver, ones), 1).T.contiguous()


def _items_first(features: Tensor) -> Tensor:
    return features.reshape(features.shape[:-2].numel(), *features.shape[-2:]).transpose(0, 1).contiguous()


def _first_layer(mlp: nn.Sequential) -> tuple[Tensor, Tensor]:
    layer = mlp[0]
    assert isinstance(layer, nn.Linear)
    return layer.weight, layer.bias


def _last_layer(mlp: nn.Sequential) -> tuple[Tensor, Tensor]:
    layer = mlp[-1]
    assert isinstance(layer, nn.Linear)
    return layer.weight, layer.bias


def _product(matrix: Tensor, items: Tensor) -> Tensor:
    """``[M, I]`` times ``[I, B, F]``: weighted sums of items, ``[M, B, F]``."""
    return (matrix @ items.flatten(1)).view(matrix.shape[0], *items.shape[1:])
