"""What a forward model asks of its network: the core."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from torchrl_gn.networks.graph import Graph, GraphSize, graph_concat
from torchrl_gn.networks.incidence import Incidence, Rows
from torchrl_gn.networks.layers import LayerList


class FoldedCore(Protocol):
    """A core for graphs of one topology and one static graph."""

    def predict(self, dynamic: Graph) -> Tensor:
        """Output nodes ``[*B, N, F_out]`` of a normalised dynamic graph ``[*B, ...]``."""
        ...


Columns = tuple[Tensor, Tensor]  # indices of columns to keep, and a factor for each


@runtime_checkable
class ReducibleCore(FoldedCore, Protocol):
    """A folded core that can drop and rescale features."""

    def reduced(self, nodes: Columns, edges: Columns, out: Columns, shift: Tensor) -> ReducibleCore:
        """The same core with fewer, rescaled dynamic and output features; ``shift`` is added to the scaled output."""
        ...


@runtime_checkable
class ListedCore(FoldedCore, Protocol):
    """A folded core that is a list of linear layers, which the native executor runs."""

    predicted: Rows  # nodes that are predicted

    def layers(self) -> LayerList | None:
        """Its layers, with tables of each sample if it was folded for many; None if they cannot be listed."""
        ...


class Core(nn.Module):
    """Network of a forward model: graph in, node features out (base class).

    A subclass implements :meth:`forward`, and :meth:`fold` if it can be evaluated faster for one topology and one
    static graph. A recurrent core sets ``hidden_size`` and implements :meth:`update`. Its constructor takes
    ``(dynamic, static, out_nodes, **options)``, with ``fixed_size = True`` also ``counts``, and calls
    ``super().__init__(dynamic)``.
    """

    fixed_size = False  # whether the core reads graphs of one size only, of which ``counts`` says (nodes, edges)

    def __init__(self, dynamic: GraphSize, *, hidden_size: GraphSize | None = None) -> None:
        super().__init__()
        self.dynamic = dynamic  # features of the dynamic graph
        self.hidden_size = hidden_size or GraphSize(0, 0, 0)  # zeros for a feed-forward core
        self.counts: tuple[int, int] | None = None  # (N, E), nodes and edges of the only graphs that it reads

    @property
    def recurrent(self) -> bool:
        """Whether it has a hidden state."""
        return self.hidden_size != GraphSize(0, 0, 0)

    def forward(self, graph: Graph) -> Graph:
        """Dynamic, hidden and static features side by side in, ``out_nodes`` node features out."""
        raise NotImplementedError

    def start(self, dynamic: Graph) -> Graph:
        """Initial hidden state, zeros, for the batch of a dynamic graph ``[*B, ...]``."""
        return dynamic.zeros(self.hidden_size)

    def update(self, dynamic: Graph, static: Graph, hidden: Graph) -> Graph:
        """Hidden state after one more dynamic graph."""
        return hidden

    def fold(self, incidence: Incidence, static: Graph) -> FoldedCore:
        """The core for one topology and one normalised static graph, differentiable in the weights.

        It must compute what :meth:`forward` computes, whatever a user has changed in the core since it was made: the
        cores here fold only what is as they made it, and else return an :class:`UnfoldedCore`.
        """
        return UnfoldedCore(self, static)


def layer_sizes(hidden: int | Sequence[int], layers: int) -> list[int]:
    """Sizes of an MLP's hidden layers: ``layers`` of one width, or those that are given."""
    return [hidden] * layers if isinstance(hidden, int) else [int(size) for size in hidden]


@dataclass(frozen=True)
class UnfoldedCore:
    """A core evaluated by message passing, edge by edge: the reference for every folded core."""

    core: Core
    static: Graph  # normalised static graph
    reason: str | None = None  # what its fold does not know; None if it has no fold, or is not to be folded

    def predict(self, dynamic: Graph) -> Tensor:
        out = self.core(graph_concat(dynamic, self.static))
        if not isinstance(out, Graph):
            raise TypeError(f"{type(self.core).__name__} must return a Graph, not {type(out).__name__}.")
        return out.nodes


def dtype_of(core: nn.Module) -> torch.dtype:
    """Dtype of a network's weights; float32 if it has none, as quantised ones."""
    for layer in (each for each in core.modules() if isinstance(each, nn.Linear)):
        # A pruned weight has its parameter's dtype only after a call. Under TorchRL's losses there are no parameters.
        return next((each.dtype for each in layer.parameters()), layer.weight.dtype)
    return next((each.dtype for each in core.parameters()), torch.float32)
