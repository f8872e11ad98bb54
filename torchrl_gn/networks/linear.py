"""Linear layers with several inputs ``[items, samples, features]``, as one autograd function."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad
from torch.nn import functional as F

from torchrl_gn.finite import is_traced

ACTIVATIONS: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "silu": nn.SiLU, "gelu": nn.GELU, "tanh": nn.Tanh}
_FUNCTIONS: dict[str, Callable[[Tensor], Tensor]] = {"silu": F.silu, "gelu": F.gelu, "tanh": torch.tanh}


def activation_class(name: str) -> type[nn.Module]:
    """Return the activation of a name; ValueError if it is not in :data:`ACTIVATIONS`."""
    if name not in ACTIVATIONS:
        raise ValueError(f"activation={name!r} is not known; use one of {list(ACTIVATIONS)}.")
    return ACTIVATIONS[name]


def linear(pairs, table=None, matrix=None, items=None, activation: str | None = None) -> Tensor:
    """Return ``activation(table + matrix @ items + sum_k x_k @ W_k.T)``, ``[I, B, h]``; any part may be missing.

    Args:
        pairs: ``x_k`` ``[I, B, F_k]`` with ``W_k`` ``[h, F_k]``; pairs without features are skipped.
        table: ``[I, 1 or B, h]``.
        matrix: ``[I, J]``.
        items: ``[J, B, h]``.
        activation: one of :data:`ACTIVATIONS`; None: the identity.
    """
    relu, plain = activation == "relu", needs_plain_operations()
    used = [tensor for pair in pairs if pair[0].shape[-1] for tensor in pair]
    if not used and items is None and table is not None:  # no input varies
        out = table.expand(-1, pairs[0][0].shape[1], -1)
        out = F.relu(out) if relu else out
    else:
        out = (_plain_layer if plain else _Layer.apply)(relu, table, matrix, items, *used)
    if relu or activation is None:
        return out
    in_place = activation == "silu" and not torch.is_grad_enabled() and not plain and bool(used)
    return F.silu(out, inplace=True) if in_place else _FUNCTIONS[activation](out)


def needs_plain_operations() -> bool:
    """Return True if a compiler, a ``torch.func`` transform or forward-mode AD must see every operation."""
    return is_traced() or forward_ad._current_level >= 0


def product(matrix: Tensor, items: Tensor) -> Tensor:
    """Multiply ``[M, I]`` by ``[I, B, F]``: weighted sums of items, ``[M, B, F]``."""
    return (matrix @ items.flatten(1)).view(matrix.shape[0], *items.shape[1:])


class _Layer(torch.autograd.Function):
    """:func:`linear` accumulated in one buffer: on a CPU, a pass over memory costs as much as a product."""

    @classmethod
    def apply(cls, *inputs):  # pyright: ignore[reportIncompatibleMethodOverride]
        """Skip torch's look-up of the signature of ``forward`` at each call: it takes longer than a small layer."""
        return super(torch.autograd.Function, cls).apply(*inputs)  # pyright: ignore[reportAttributeAccessIssue]

    @staticmethod
    def forward(relu, table, matrix, items, *pairs):
        features, weights = pairs[::2], pairs[1::2]
        count, batch = features[0].shape[:2]
        flat = [x.reshape(count * batch, x.shape[-1]) for x in features]
        start = int(items is None)
        out = flat[0] @ weights[0].T if start else product(matrix, items).flatten(0, 1)
        for x, weight in zip(flat[start:], weights[start:], strict=True):
            torch.addmm(out, x, weight.T, out=out)  # in place, and counted by FlopCounterMode
        shaped = out.view(count, batch, out.shape[-1])
        if table is not None:
            shaped.add_(table)
        return shaped.relu_() if relu else shaped

    @staticmethod
    def setup_context(ctx, inputs, output):
        relu, table, matrix, items, *pairs = inputs
        ctx.relu, ctx.table_batch = relu, None if table is None else table.shape[1]
        ctx.save_for_backward(output if relu else None, matrix, *pairs)

    @staticmethod
    def backward(ctx, grad):  # pyright: ignore[reportIncompatibleMethodOverride]
        out, matrix, *pairs = ctx.saved_tensors
        if ctx.relu:
            grad = torch.ops.aten.threshold_backward(grad, out, 0)
        count, batch, size = grad.shape
        flat_grad = grad.reshape(count * batch, size)
        needs = ctx.needs_input_grad
        table = items = None
        if needs[1]:
            table = grad.sum(1, keepdim=True) if ctx.table_batch == 1 else grad
        if matrix is not None and needs[3]:
            items = (matrix.T @ flat_grad.view(count, batch * size)).view(matrix.shape[1], batch, size)
        gradients = []
        for index, (x, weight) in enumerate(zip(pairs[::2], pairs[1::2], strict=True)):
            gradients.append((flat_grad @ weight).view(x.shape) if needs[4 + 2 * index] else None)
            gradients.append(flat_grad.T @ x.reshape(len(flat_grad), x.shape[-1]) if needs[5 + 2 * index] else None)
        return None, table, None, items, *gradients


def _plain_layer(relu, table, matrix, items, *pairs):
    """Compute :class:`_Layer` by single torch operations."""
    terms = [F.linear(x, weight) for x, weight in zip(pairs[::2], pairs[1::2], strict=True)]
    if items is not None:
        terms.append(product(matrix, items))
    if table is not None:
        terms.append(table)
    out = terms[0]
    for term in terms[1:]:
        out = out + term
    return F.relu(out) if relu else out
