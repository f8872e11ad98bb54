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
from torchrl_gn.networks.layers import LayerList


class NativeDelta(NativeExecutor):
    """Predicted changes, differentiable once in states, actions and the weights of the program's core.

    State maths in float64, the network and its weights' gradient in the program's dtype, summed in an order that does
    not depend on the number of threads.
    """

    change = True

    def _packed(self, network: library.NativeNetwork, layers: LayerList) -> library.NativeNetwork:
        # Gradients of earlier predictions, with other weights, may be asked for later: leave their network as it is.
        for kept, tensors in zip(network.kept[2], layers.tensors(), strict=True):
            for before, now in zip(kept, tensors, strict=True):
                if before is not None and not torch.equal(before, now):  # pyright: ignore[reportArgumentType]
                    return library.NativeNetwork(layers, network.dtype)
        return network

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
            if library.rollout(network, maths, (*call, stored.tensor.data_ptr(), 1, None, None)):
                break
            executor.trace(state)
        ctx.save_for_backward(state, action)
        ctx.start, ctx.maths, ctx.network, ctx.stored = start, maths, network, stored
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        network, (state, action) = ctx.network, ctx.saved_tensors
        gradient = gradient.contiguous()
        of_state, of_action = torch.empty_like(state), torch.empty_like(action)
        packed = network.kept[2]
        weights, tables = ([None if each is None else torch.empty_like(each) for each in part] for part in packed)
        addresses = library.pointers(weights), library.pointers(tables)
        call = (
            *(*ctx.start, _array(gradient), 0, _array(of_state), _array(of_action)),
            *(ctx.stored.tensor.data_ptr(), 1, *map(ctypes.addressof, addresses)),
        )
        library.rollout_adjoint(network, ctx.maths, call)
        return None, of_state, of_action, *weights, *tables


def _array(tensor: Tensor) -> tuple[int, int]:
    return tensor.data_ptr(), DTYPES[tensor.dtype]
