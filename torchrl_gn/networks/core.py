"""The core: interface of a forward model's network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from torchrl_gn.checks import check_count
from torchrl_gn.networks.graph import Graph, GraphSize, graph_concat
from torchrl_gn.networks.incidence import Incidence, Rows
from torchrl_gn.networks.layers import LayerList


class FoldedCore(Protocol):
    """A core for graphs of one topology and one static graph."""

    def predict(self, dynamic: Graph) -> Tensor:
        """Return the output nodes ``[*B, N, F_out]`` for a normalised dynamic graph ``[*B, ...]``."""
        ...


Columns = tuple[Tensor, Tensor]  # indices of columns to keep, and a factor for each


@runtime_checkable
class ReducibleCore(FoldedCore, Protocol):
    """A folded core that can drop and rescale features."""

    def reduced(self, nodes: Columns, edges: Columns, out: Columns, shift: Tensor) -> ReducibleCore:
        """Return the core with fewer, rescaled dynamic and output features.

        ``shift`` is added to the scaled output.
        """
        ...


@runtime_checkable
class ListedCore(FoldedCore, Protocol):
    """A folded core that is a list of linear layers, which the native executor runs."""

    predicted: Rows  # predicted nodes

    def layers(self) -> LayerList | None:
        """Return the layers, with one table per sample if folded for many; None if they cannot be listed."""
        ...


class Core(nn.Module):
    """Network of a forward model: graph in, node features out (base class).

    A subclass implements :meth:`forward`, and :meth:`fold` if it can be evaluated faster for one topology and one
    static graph. A recurrent core sets ``hidden_size`` and implements :meth:`update`. The constructor of a subclass
    takes ``(dynamic, static, out_nodes, **options)``, with ``fixed_size = True`` also ``counts``, and calls
    ``super().__init__(dynamic)``.
    """

    fixed_size = False  # True: the core reads graphs of one size only, ``counts`` = (nodes, edges)

    def __init__(self, dynamic: GraphSize, *, hidden_size: GraphSize | None = None) -> None:
        super().__init__()
        self.dynamic = dynamic  # features of the dynamic graph
        self.hidden_size = hidden_size or GraphSize(0, 0, 0)  # zeros for a feed-forward core
        self.counts: tuple[int, int] | None = None  # (N, E) of the graphs; None: any size

    @property
    def recurrent(self) -> bool:
        """True if the core has a hidden state."""
        return self.hidden_size != GraphSize(0, 0, 0)

    def forward(self, graph: Graph) -> Graph:
        """Map concatenated dynamic, hidden and static features to ``out_nodes`` features per node."""
        raise NotImplementedError

    def start(self, dynamic: Graph) -> Graph:
        """Return the initial hidden state, zeros, for the batch of a dynamic graph ``[*B, ...]``."""
        return dynamic.zeros(self.hidden_size)

    def update(self, dynamic: Graph, static: Graph, hidden: Graph) -> Graph:
        """Return the hidden state after one more dynamic graph."""
        return hidden

    def fold(self, incidence: Incidence, static: Graph) -> FoldedCore:
        """Return the core for one topology and one normalised static graph, differentiable in the weights.

        The folded core must compute what :meth:`forward` computes, even if a user has changed the core since its
        construction. The cores of this package therefore fold only layers that they know, and otherwise return an
        :class:`UnfoldedCore`.
        """
        return UnfoldedCore(self, static)


def layer_sizes(hidden: int | Sequence[int], layers: int) -> list[int]:
    """Return the sizes of an MLP's hidden layers: ``layers`` of the width ``hidden``, or ``hidden`` itself.

    Raises:
        ValueError: if a size is not a whole number of at least 1.
    """
    sizes = [hidden] * layers if isinstance(hidden, (int, Integral)) else list(hidden)
    for size in sizes:
        check_count("hidden", size, 1)
    return [int(size) for size in sizes]


@dataclass(frozen=True)
class UnfoldedCore:
    """A core evaluated by message passing, edge by edge: the reference for every folded core."""

    core: Core
    static: Graph  # normalised static graph
    reason: str | None = None  # change that prevents folding; None: the core has no fold, or folding is not wanted

    def predict(self, dynamic: Graph) -> Tensor:
        out = self.core(graph_concat(dynamic, self.static))
        if not isinstance(out, Graph):
            raise TypeError(f"{type(self.core).__name__} must return a Graph, not {type(out).__name__}.")
        return out.nodes


def dtype_of(core: nn.Module) -> torch.dtype:
    """Return the dtype of a network's weights; float32 if it has none, like quantised networks."""
    for layer in (each for each in core.modules() if isinstance(each, nn.Linear)):
        # Ask a parameter first: a pruned weight takes its dtype only at the next call. Layers in TorchRL's losses have
        # no parameters.
        return next((each.dtype for each in layer.parameters()), layer.weight.dtype)
    return next((each.dtype for each in core.parameters()), torch.float32)
