"""Predicted changes of a program whose weights are trained, in compiled C++."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from torchrl_gn.dynamics.executors import eager
from torchrl_gn.dynamics.executors.native import library
from torchrl_gn.dynamics.executors.native.executor import DTYPES, TILE, NativeExecutor, NotTracedError
from torchrl_gn.networks.graph import Graph


class NativeDelta(NativeExecutor):
    """Predicted changes, differentiable once in states, actions and the weights of the program's core.

    State maths in float64, the network and its weights' gradient in the program's dtype, summed in an order that does
    not depend on the number of threads.
    """

    change = True

    def delta(self, state: Tensor, action: Tensor, hidden: Graph | None = None) -> tuple[Tensor, Graph | None]:
        """Predicted change ``[*B, N, 12]``, as :func:`~torchrl_gn.dynamics.executors.eager.delta`."""
        if self._runs(state, action) and self.program.dtype in DTYPES:
            assert self.layers is not None
            weights, tables = self.layers.tensors()
            try:
                return _Trained.apply(self, state, action, *weights, *tables), None  # pyright: ignore[reportReturnType]
            except NotTracedError:
                pass
        return eager.delta(self.program, state, action, hidden)


class _Trained(torch.autograd.Function):
    @staticmethod
    def forward(ctx, executor: NativeDelta, state: Tensor, action: Tensor, *tensors: Tensor | None) -> Tensor:
        state, action, network = state.contiguous(), action.contiguous(), executor.network
        assert network is not None
        count, threads, size = state.shape[:-2].numel(), torch.get_num_threads(), state.shape[-2] * state.shape[-1]
        out = torch.empty((*state.shape[:-1], executor.program.layout.delta_size), dtype=state.dtype)
        executor.prepare(state)
        start = (count, 1, min(TILE, count), threads, _array(state), size, _array(action))
        while True:
            maths = executor.maths
            assert maths is not None
            call = (*start, _array(out), 0, library.NOTHING, library.NOTHING)
            size = library.stored_count(network, maths, (*call, None, 1, None, None))
            stored = executor.pool.take(size, network.number)
            if library.rollout(network, maths, (*call, stored.data_ptr(), 1, None, None)):
                break
            executor.trace(state)
        ctx.save_for_backward(state, action)
        ctx.stored, ctx.executor, ctx.start, ctx.maths, ctx.network, ctx.packed = (
            stored,
            executor,
            start,
            maths,
            network,
            network.kept,
        )
        ctx.needed = any(tensor is not None and tensor.requires_grad for tensor in tensors)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        network, stored, (state, action) = ctx.network, ctx.stored, ctx.saved_tensors
        if stored is None:
            raise RuntimeError("The gradient of a native prediction can be computed once; predict again.")
        ctx.stored = None
        if network.kept is not ctx.packed:
            raise RuntimeError("The model's weights changed between a prediction and its gradient; predict again.")
        gradient = gradient.contiguous()
        of_state, of_action = torch.empty_like(state), torch.empty_like(action)
        packed = network.kept[2]
        weights, tables = ([None if each is None else torch.empty_like(each) for each in part] for part in packed)
        addresses = library.pointers(weights), library.pointers(tables)
        call = (
            *(*ctx.start, _array(gradient), 0, _array(of_state), _array(of_action)),
            *(stored.data_ptr(), 1, *map(ctypes.addressof, addresses)),
        )
        library.rollout_adjoint(network, ctx.maths, call)
        ctx.executor.pool.give(stored)
        return None, of_state, of_action, *weights, *tables


def _array(tensor: Tensor) -> tuple[int, int]:
    return tensor.data_ptr(), DTYPES[tensor.dtype]
