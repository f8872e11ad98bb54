"""Predicted changes of a program whose weights are trained, in compiled C++."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from torchrl_gn.dynamics.executors import eager
from torchrl_gn.dynamics.executors.native import library
from torchrl_gn.dynamics.executors.native.executor import Native, NativeExecutor
from torchrl_gn.dynamics.executors.native.trace import UntraceableError
from torchrl_gn.dynamics.executors.native.traced_program import MixedStatesError
from torchrl_gn.networks.graph import Graph


class NativeDelta(NativeExecutor):
    """Predicted changes, differentiable once in states, actions and the weights of the program's core.

    State maths in float64, the network and its weights' gradient in the program's dtype, summed in an order that does
    not depend on the number of threads.
    """

    change = True

    def delta(self, state: Tensor, action: Tensor, hidden: Graph | None = None) -> tuple[Tensor, Graph | None]:
        """Predicted change ``[*B, N, 12]``, as :func:`~torchrl_gn.dynamics.executors.eager.delta`."""
        native = self.running(state, action)
        if native is not None and native.network.dtype in library.DTYPES:
            weights, tables = native.layers.tensors()
            try:
                out = _Trained.apply(self, native, state, action, *weights, *tables)
                return out, None  # pyright: ignore[reportReturnType]
            except (MixedStatesError, UntraceableError):
                pass
        return eager.delta(self.program, state, action, hidden)


class _Trained(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx, executor: NativeDelta, native: Native, state: Tensor, action: Tensor, *tensors: Tensor | None
    ) -> Tensor:
        state, action, network = state.contiguous(), action.contiguous(), native.network
        shape = (*state.shape[:-1], executor.program.layout.delta_size)
        call, out = library.forward_call(state, action, False, shape=shape)
        call.train, call.tile = True, min(library.TILE, call.batch)  # a tile, and so the sums, whatever the threads
        ctx.stored = executor.pool.take(library.trained_count(network, call), network.number)
        call.stored = ctx.stored.tensor.data_ptr()
        native.samples.bring(call)
        ctx.maths = native.traced.run(network, call, state, action)
        ctx.save_for_backward(state, action)
        ctx.native, ctx.call = native, call
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        network, (state, action) = ctx.native.network, ctx.saved_tensors
        packed = network.weights, network.tables
        weights, tables = ([None if each is None else torch.empty_like(each) for each in part] for part in packed)
        addresses = library.pointers(weights), library.pointers(tables)
        gradient, stored = gradient.contiguous(), ctx.stored.tensor  # to live until the call is done
        call, of_state, of_action = library.adjoint_call(ctx.call, state, action, gradient, stored)
        call.grad_weights, call.grad_tables = map(ctypes.addressof, addresses)
        library.rollout_adjoint(network, ctx.maths, call)
        return None, None, of_state, of_action, *weights, *tables
