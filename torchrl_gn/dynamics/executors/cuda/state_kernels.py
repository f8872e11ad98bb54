"""State maths on a GPU as two differentiable functions, before and after the network."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import torch
from torch import Tensor

from torchrl_gn.dynamics.executors.cuda.nvrtc import Kernel, compile_together
from torchrl_gn.dynamics.executors.cuda.source import KERNELS, KernelTypes, Layout, kernel_sources
from torchrl_gn.dynamics.executors.native.state_maths import StateMaths

Launch = Callable[..., None]  # called like a Kernel

_TYPES = {torch.float32: "float", torch.float64: "double", torch.bfloat16: "bfloat16"}


class StateKernels:
    """The kernels of one scene's state maths, cached by the dtypes of state, action and network."""

    def __init__(self, maths: StateMaths, layout: Layout, *, make: Callable[[str, str], Launch] = Kernel) -> None:
        self.maths, self.layout, self._make = maths, layout, make
        self._kernels: dict[tuple[str, KernelTypes], tuple[list[Launch], int]] = {}

    def kernels(self, name: str, types: KernelTypes) -> tuple[list[Launch], int]:
        """Return the launches of a kernel of :data:`KERNELS`, in order, and the number of scratch registers."""
        if (kernels := self._kernels.get((name, types))) is None:
            sources, registers = kernel_sources(name, self.maths, self.layout, types)
            kernels = self._kernels[name, types] = [self._make(name, source) for source in sources], registers
        return kernels

    def prepare(self, types: KernelTypes, device: torch.device, *, gradient: bool) -> None:
        """Compile the kernels of a step, and with ``gradient`` of its gradient, unless they are compiled."""
        names = KERNELS[: 4 if gradient else 2]
        if device.type == "cuda" and any((name, types) not in self._kernels for name in names):
            compile_together([cast(Kernel, each) for name in names for each in self.kernels(name, types)[0]], device)

    def launch(self, name: str, types: KernelTypes, count: int, numbers: Tensor, *tensors: Tensor) -> None:
        if not count:
            return
        (kernels, registers), stride = self.kernels(name, types), 0 if len(numbers) == 1 else numbers.shape[1]
        scratch = numbers.new_empty(registers, count)
        for kernel in kernels:
            kernel(count, count, stride, scratch, *tensors)


def kernel_types(state: Tensor, action: Tensor, network: torch.dtype) -> KernelTypes:
    """Return the C++ types for these tensors; KeyError for other dtypes."""
    return KernelTypes(_TYPES[state.dtype], _TYPES[action.dtype], _TYPES[network])


class NetworkInputs(torch.autograd.Function):
    """Network inputs ``[N, B, F_n]`` and ``[E, B, F_e]`` from states ``[B, N, C]`` and actions ``[B, A]``."""

    @staticmethod
    def forward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, kernels: StateKernels, shapes: Any, dtype: torch.dtype, state: Tensor, action: Tensor, numbers: Tensor
    ) -> tuple[Tensor, Tensor]:
        ctx.kernels, ctx.types = kernels, kernel_types(state, action, dtype)
        (nodes, node_width), (edges, edge_width) = shapes
        node_features = state.new_empty(nodes, len(state), node_width, dtype=dtype)
        edge_features = state.new_empty(edges, len(state), edge_width, dtype=dtype)
        out = node_features, edge_features
        kernels.launch("inputs", ctx.types, len(state), numbers, state, action, numbers, *out)
        ctx.save_for_backward(state, action, numbers)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple:  # pyright: ignore[reportIncompatibleMethodOverride]
        state, action, numbers = ctx.saved_tensors
        input_gradients = torch.empty_like(state), torch.empty_like(action)
        inputs = state, action, numbers, *(each.contiguous() for each in gradients), *input_gradients
        ctx.kernels.launch("inputs_adjoint", ctx.types, len(state), numbers, *inputs)
        return None, None, None, *input_gradients, None


class StepResult(torch.autograd.Function):
    """Next states (or changes) from states ``[B, N, C]``, actions ``[B, A]`` and network outputs ``[P, B, F]``."""

    @staticmethod
    def forward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, kernels: StateKernels, state: Tensor, action: Tensor, numbers: Tensor, output: Tensor
    ) -> Tensor:
        ctx.kernels, ctx.types = kernels, kernel_types(state, action, output.dtype)
        out = state.new_empty(len(state), state.shape[1], kernels.layout.result // state.shape[1])
        kernels.launch("result", ctx.types, len(state), numbers, state, action, numbers, output, out)
        ctx.save_for_backward(state, action, numbers, output)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple:  # pyright: ignore[reportIncompatibleMethodOverride]
        state, action, numbers, output = ctx.saved_tensors
        input_gradients = torch.empty_like(output), torch.empty_like(state), torch.empty_like(action)
        inputs = state, action, numbers, output, gradient.contiguous(), *input_gradients
        ctx.kernels.launch("result_adjoint", ctx.types, len(state), numbers, *inputs)
        output_gradient, state_gradient, action_gradient = input_gradients
        return None, state_gradient, action_gradient, None, output_gradient
