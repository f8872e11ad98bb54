"""Run a step program on an NVIDIA GPU: state maths in CUDA kernels, the network by torch, steps as CUDA graphs."""

from __future__ import annotations

import functools
import math
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad

from torchrl_gn.cache import keep_inductor_private
from torchrl_gn.dynamics.executors import eager
from torchrl_gn.dynamics.executors.cuda.graphs import StepGraph
from torchrl_gn.dynamics.executors.cuda.nvrtc import NoCudaCompilerError, check_compiler
from torchrl_gn.dynamics.executors.cuda.source import Layout
from torchrl_gn.dynamics.executors.cuda.state_kernels import NetworkInputs, StateKernels, StepResult, kernel_types
from torchrl_gn.dynamics.executors.native.executor import list_layers
from torchrl_gn.dynamics.executors.native.samples import ParameterInputs
from torchrl_gn.dynamics.executors.native.state_maths import StateMaths
from torchrl_gn.dynamics.executors.native.trace import UntraceableError
from torchrl_gn.dynamics.program import StepProgram
from torchrl_gn.networks.core import FoldedCore, ListedCore
from torchrl_gn.networks.folded_gn_core import FoldedGNCore
from torchrl_gn.networks.graph import Graph
from torchrl_gn.networks.tensor_tree import copy_of, leaves, rebuild, skeleton

_DTYPES = (torch.float32, torch.float64)  # of states and actions
_MOST_GRAPHS = 8  # each keeps the memory of its step


class CudaExecutor:
    """Executor for NVIDIA GPUs; it falls back to torch operations, and ``reason`` says why.

    State maths runs in float64 kernels, one thread per sample. They are compiled at the first call of a scene (seconds
    to minutes) and kept in the user's cache. Torch runs the network in the program's dtype. Differentiable once, in
    state, action and weights. Not thread-safe: recorded steps share their memory.

    Args:
        program: any of the programs to run.
        change: whether kernels run :meth:`delta`, instead of :meth:`step` and :meth:`rollout`.
        graphs: whether to record steps as CUDA graphs, one per number of samples; only for programs whose tensors keep
            their addresses.
        compiles: whether the network goes through ``torch.compile``.
    """

    fixed_batch = False

    def __init__(
        self,
        program: StepProgram,
        *,
        change: bool = False,
        graphs: bool = True,
        compiles: bool = False,
        make: Callable[..., Any] | None = None,
    ) -> None:
        self.change, self.graphs, self.compiles, self.reason = change, graphs, compiles, None
        self._devices = ("cuda",) if make is None else ("cuda", "cpu")
        self._recorded: OrderedDict[tuple, StepGraph] = OrderedDict()
        plain = moved(program, "cpu")
        layers, self.reason = list_layers(plain)
        if layers is None:
            return
        core, last = plain.core, layers.layers[-1]
        assert isinstance(core, ListedCore)
        predicted = torch.arange(layers.nodes[0])[core.predicted].numpy()
        width = last.count * len(last.weight) // max(len(predicted), 1)
        shape = program.reference.shape
        self.parameters = ParameterInputs.of(plain)
        try:
            if make is None:
                check_compiler()
            maths = StateMaths(
                plain, np.zeros(shape), np.zeros(shape, dtype=bool), predicted, width, self.parameters, change
            )
        except (NoCudaCompilerError, UntraceableError) as error:
            self.reason = str(error)
            return
        self._inputs = layers.nodes, layers.edges
        layout = Layout(
            state=maths.is_constant.size,
            result=maths.result_size,
            actions=maths.actions,
            node_inputs=layers.nodes[0] * layers.nodes[1],
            node_width=layers.nodes[1],
            edge_width=layers.edges[1],
            output_width=width,
        )
        self._kernels = StateKernels(maths, layout, **({} if make is None else {"make": make}))

    def __getstate__(self) -> dict:
        return self.__dict__ | {"_recorded": OrderedDict()}  # a copy records its own graphs

    def pack(self, program: StepProgram) -> StepProgram:
        return program

    def step(
        self, program: StepProgram, state: Tensor, action: Tensor, hidden: Graph | None = None
    ) -> tuple[Tensor, Graph | None]:
        if self.change or not self._runs(program, state, action):
            return eager.step(program, state, action, hidden)
        flat_state, flat_action = _flat(state, 2), _flat(action, 1)
        if self._records(program):
            after = _Rollout.apply(self, program, flat_state, flat_action.unsqueeze(1))[:, 1]
        else:
            after = self._step(program, flat_state, flat_action)
        return after.view(state.shape), None

    def rollout(
        self, program: StepProgram, state: Tensor, actions: Tensor, hidden: Graph | None = None
    ) -> tuple[Tensor, Graph | None]:
        if self.change or not self._runs(program, state, actions):
            return eager.rollout(program, state, actions, hidden)
        flat_state, flat_actions = _flat(state, 2), _flat(actions, 2)
        if self._records(program):
            states = _Rollout.apply(self, program, flat_state, flat_actions)
        else:
            trajectory = [flat_state]
            for action in flat_actions.unbind(1):
                trajectory.append(self._step(program, trajectory[-1], action.contiguous()))
            states = torch.stack(trajectory, 1)
        return states.view(*state.shape[:-2], *states.shape[1:]), None

    def delta(
        self, program: StepProgram, state: Tensor, action: Tensor, hidden: Graph | None = None
    ) -> tuple[Tensor, Graph | None]:
        """Return the predicted change ``[*B, N, 12]``; see :func:`~torchrl_gn.dynamics.executors.eager.delta`."""
        if not self.change or not self._runs(program, state, action):
            return eager.delta(program, state, action, hidden)
        change = self._step(program, _flat(state, 2), _flat(action, 1))
        return change.view(*state.shape[:-1], -1), None

    def _runs(self, program: StepProgram, state: Tensor, actions: Tensor) -> bool:
        """Return True if the kernels compute this call."""
        return (
            self.reason is None
            and state.dtype in _DTYPES
            and actions.dtype in _DTYPES
            and state.device == actions.device == program.movable.device
            and state.device.type in self._devices  # false for a copy that was moved to the CPU
            and not torch.compiler.is_compiling()
            and not torch._C._are_functorch_transforms_active()
            and forward_ad._current_level < 0
        )

    def _records(self, program: StepProgram) -> bool:
        """Return True if steps are recorded: not with per-sample parameters, trained weights or an outer recording."""
        return (
            self.graphs
            and program.movable.is_cuda
            and not len(self.parameters)
            and not torch.cuda.is_current_stream_capturing()
            and not any(leaf.requires_grad for _, leaf in leaves(program.core) if isinstance(leaf, Tensor))
        )

    def _step(self, program: StepProgram, state: Tensor, action: Tensor) -> Tensor:
        """Return the result for contiguous states ``[B, N, C]`` and actions ``[B, A]``."""
        gradient = torch.is_grad_enabled() and any(
            leaf.requires_grad for leaf in (state, action, *(each for _, each in leaves(program.core)))
        )
        types = kernel_types(state, action, program.dtype)
        self._kernels.prepare(types, state.device, gradient=gradient)
        numbers = self.parameters.numbers(program)
        nodes, edges = NetworkInputs.apply(self._kernels, self._inputs, program.dtype, state, action, numbers)
        output = self.network(program, nodes, edges)
        return StepResult.apply(self._kernels, state, action, numbers, output)

    def network(self, program: StepProgram, nodes: Tensor, edges: Tensor) -> Tensor:
        """Return the network's output ``[P, B, F_out]`` for inputs ``[N, B, F_n]`` and ``[E, B, F_e]``."""
        if not self.compiles:
            return predict(program.core, program.edge_index, nodes, edges)
        return _compiled_network()(program.core, program.edge_index, nodes, edges)

    def recorded(self, program: StepProgram, kind: str, state: Tensor, action: Tensor) -> StepGraph:
        """Return the CUDA graph of a step (``"after"``) or its gradient (``"vjp"``) for this number of samples."""
        tensors = [leaf for _, leaf in leaves(program) if isinstance(leaf, Tensor)]
        places = tuple(tensor.data_ptr() for tensor in tensors)
        settings = torch.backends.cuda.matmul.allow_tf32
        key = (kind, len(state), state.dtype, action.dtype, program.dtype, settings, *places)
        if (graph := self._recorded.get(key)) is None:
            function = self._advance if kind == "after" else self._vjp
            inputs = [torch.zeros_like(each, memory_format=torch.contiguous_format) for each in (state, action)]
            inputs[0].copy_(program.reference)
            if kind == "vjp":
                inputs.append(torch.zeros_like(inputs[0]))
            graph = self._recorded[key] = StepGraph(lambda *arguments: function(program, *arguments), inputs)
            if len(self._recorded) > _MOST_GRAPHS:
                self._recorded.popitem(last=False)
        self._recorded.move_to_end(key)
        return graph

    def _advance(self, program: StepProgram, state: Tensor, action: Tensor) -> tuple[Tensor, ...]:
        with torch.no_grad():
            after = self._step(program, state, action)
            state.copy_(after)  # for the next step
        return (after,)

    def _vjp(self, program: StepProgram, state: Tensor, action: Tensor, gradient: Tensor) -> tuple[Tensor, ...]:
        with torch.enable_grad():
            inputs = state.detach().requires_grad_(), action.detach().requires_grad_()
            after = self._step(program, *inputs)
            return torch.autograd.grad(after, inputs, gradient)


class _Rollout(torch.autograd.Function):
    """States ``[B, T + 1, N, C]`` by recorded steps; the gradient recomputes each step."""

    @staticmethod
    def forward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, executor: CudaExecutor, program: StepProgram, state: Tensor, actions: Tensor
    ) -> Tensor:
        count, steps = actions.shape[:2]
        states = state.new_empty(count, steps + 1, *state.shape[1:])
        states[:, 0] = state
        ctx.vjp = None
        if count and steps:
            if any(ctx.needs_input_grad):  # record here, not in autograd's threads
                ctx.vjp = executor.recorded(program, "vjp", state, actions[:, 0])
            step = executor.recorded(program, "after", state, actions[:, 0])
            step.inputs[0].copy_(state)
            for t in range(steps):
                step.inputs[1].copy_(actions[:, t])
                step.replay()
                states[:, t + 1] = step.outputs[0]
        ctx.save_for_backward(states, actions)
        return states

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradients: Tensor) -> tuple:  # pyright: ignore[reportIncompatibleMethodOverride]
        states, actions = ctx.saved_tensors
        of_actions, gradient = torch.zeros_like(actions), gradients[:, -1].contiguous()
        if (vjp := ctx.vjp) is not None:
            for t in reversed(range(actions.shape[1])):
                for static, tensor in zip(vjp.inputs, (states[:, t], actions[:, t], gradient), strict=True):
                    static.copy_(tensor)
                vjp.replay()
                of_actions[:, t] = vjp.outputs[1]
                gradient = vjp.outputs[0] + gradients[:, t]
        return None, None, gradient, of_actions


def moved(program: StepProgram, device: torch.device | str) -> StepProgram:
    """Return the program on another device, detached."""
    copies: dict[int, Any] = {}  # shared leaves stay shared

    def there(leaf: Any) -> Any:
        if id(leaf) not in copies:
            copies[id(leaf)] = leaf.detach().to(device) if isinstance(leaf, Tensor) else copy_of(leaf).to(device)
        return copies[id(leaf)]

    return rebuild(skeleton(program), (there(leaf) for _, leaf in leaves(program)))


def predict(core: FoldedCore, edge_index: Tensor, nodes: Tensor, edges: Tensor) -> Tensor:
    """Compute the network's output ``[P, B, F_out]`` from ``[N, B, F_n]`` and ``[E, B, F_e]`` by torch operations."""
    empty = nodes.new_empty(nodes.shape[1], 0)
    if isinstance(core, FoldedGNCore):
        return core(nodes, edges, empty.unsqueeze(0)).contiguous()
    full = core.predict(Graph(nodes.transpose(0, 1), edges.transpose(0, 1), empty, edge_index))
    return full[:, cast(ListedCore, core).predicted].transpose(0, 1).contiguous()


@functools.cache
def _compiled_network() -> Callable[..., Tensor]:
    """Return :func:`predict` through ``torch.compile``, compiled for every structure, dtype and number of samples."""
    keep_inductor_private()
    compiled = torch.compile(predict, fullgraph=True, dynamic=False)

    def run(*given: Any) -> Tensor:
        with torch._dynamo.config.patch(recompile_limit=1000, accumulated_recompile_limit=1000):
            return compiled(*given)

    return run


def _flat(tensor: Tensor, dims: int) -> Tensor:
    """Flatten the batch to one dimension before the last ``dims``."""
    batch = tensor.shape[: tensor.ndim - dims]
    return tensor.reshape(math.prod(batch), *tensor.shape[tensor.ndim - dims :]).contiguous()
