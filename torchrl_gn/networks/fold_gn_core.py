"""Fold the weights of a :class:`~torchrl_gn.networks.GNCore` for one scene."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_gn.networks.folded_gn_core import Factors, FoldedGNCore, items_first
from torchrl_gn.networks.graph import Graph, GraphSize
from torchrl_gn.networks.incidence import Incidence

if TYPE_CHECKING:
    from torchrl_gn.networks.gn_core import GNCore


def fold_gn_core(core: GNCore, size: GraphSize, incidence: Incidence, static: Graph) -> FoldedGNCore:
    """Fold a core for graphs of one topology; differentiable in the core's weights and the static graph.

    Args:
        core: the core to fold.
        size: features of the dynamic graphs.
        incidence: the topology, and the nodes to predict.
        static: normalised static graph, the rest of the core's input; any part may have the batch of dynamic graphs.
    """
    n, e, g = size.nodes, size.edges, size.globals_
    sn, se, sg = static.nodes.shape[-1], static.edges.shape[-1], static.globals_.shape[-1]
    first, second = core.first, core.second
    num_nodes, num_edges = incidence.num_nodes, incidence.num_edges
    kept, rows = incidence.kept_rows, incidence.predicted_rows
    dtype = _layer(first.edge_mlp, 0)[0].dtype
    degree = incidence.degree.to(dtype)

    static_nodes, static_globals = items_first(static.nodes), items_first(static.globals_.unsqueeze(-2))
    sides = (*(static_nodes[ends] for ends in incidence.edge_index), items_first(static.edges))
    static_edges = torch.cat(_broadcast(sides), dim=-1)

    # First block. Weight columns: globals, sender, receiver, edge; each dynamic then static.
    weight, bias = _layer(first.edge_mlp, 0)
    wg, wsg, ws, wss, wr, wsr, we, wse = weight.split((g, sg, n, sn, n, sn, e, se), dim=1)
    table = bias + F.linear(static_edges, torch.cat((wss, wsr, wse), 1)) + F.linear(static_globals, wsg)
    first_edge = _factors(first.edge_mlp, (torch.cat((ws, wr, we), 1), wg), table)
    edge_out, edge_bias = _layer(first.edge_mlp, -1)

    weight, bias = _layer(first.node_mlp, 0)
    wg, wsg, wn, wsn, wa = weight.split((g, sg, n, sn, edge_out.shape[0]), dim=1)
    table = bias + F.linear(static_nodes, wsn) + F.linear(static_globals, wsg) + degree * (wa @ edge_bias)
    first_node = _factors(first.node_mlp, (wa @ edge_out, wn, wg), table)
    node_out, node_bias = _layer(first.node_mlp, -1)

    weight, bias = _layer(first.global_mlp, 0)
    wg, wsg, wn, we = weight.split((g, sg, node_out.shape[0], edge_out.shape[0]), dim=1)
    if first.pool == "mean":
        wn, we = wn / num_nodes, we / max(num_edges, 1)
    table = bias + F.linear(static_globals, wsg) + num_nodes * (wn @ node_bias) + num_edges * (we @ edge_bias)
    first_global = _factors(first.global_mlp, (wn @ node_out, we @ edge_out, wg), table)
    global_out, global_bias = _layer(first.global_mlp, -1)

    # Second block: its input is the first block's input and output side by side.
    latent_g, latent_n, latent_e = global_out.shape[0], node_out.shape[0], edge_out.shape[0]
    weight, bias = _layer(second.edge_mlp, 0)
    wg, wsg, wlg, ws, wss, wls, wr, wsr, wlr, we, wse, wle = weight.split(
        (g, sg, latent_g, n, sn, latent_n, n, sn, latent_n, e, se, latent_e), dim=1
    )
    table = bias + F.linear(static_edges, torch.cat((wss, wsr, wse), 1)) + F.linear(static_globals, wsg)
    table = table + wlg @ global_bias + (wls + wlr) @ node_bias + wle @ edge_bias
    second_edge = _factors(second.edge_mlp, (wle @ edge_out, torch.cat((ws, wr, we), 1)), table[kept])
    second_ends, second_globals = (wls @ node_out, wlr @ node_out), (wlg @ global_out, wg)
    edge_out, edge_bias = _layer(second.edge_mlp, -1)

    weight, bias = _layer(second.node_mlp, 0)
    wg, wsg, wlg, wn, wsn, wln, wa = weight.split((g, sg, latent_g, n, sn, latent_n, edge_out.shape[0]), dim=1)
    table = bias + F.linear(static_nodes, wsn) + F.linear(static_globals, wsg) + degree * (wa @ edge_bias)
    table = (table + wlg @ global_bias + wln @ node_bias)[rows]
    return FoldedGNCore(
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
        out=_layer(second.node_mlp, -1),
        activation=core.activation,
    )


def _factors(mlp: nn.Sequential | None, weights: tuple[Tensor, ...], table: Tensor) -> Factors:
    assert mlp is not None
    hidden = [layer for layer in list(mlp)[2:-1:2] if isinstance(layer, nn.Linear)]
    return Factors(weights, table, tuple((layer.weight, layer.bias) for layer in hidden))


def _broadcast(parts) -> list[Tensor]:
    """Expand all parts ``[I, 1 or B, F]`` to the larger batch."""
    (batch,) = torch.broadcast_shapes(*(part.shape[1:2] for part in parts))
    return [part.expand(-1, batch, -1) for part in parts]


def _layer(mlp: nn.Sequential | None, index: int) -> tuple[Tensor, Tensor]:
    assert mlp is not None
    layer = mlp[index]
    assert isinstance(layer, nn.Linear)
    return layer.weight, layer.bias
