"""Run a step program in compiled C++: whole rollouts, and their gradients, in one call."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.dynamics.executors.eager import EagerExecutor, rollout_by_steps
from torchrl_gn.dynamics.executors.native import library
from torchrl_gn.dynamics.executors.native.state_maths import StateMaths, may_be_constant
from torchrl_gn.dynamics.executors.native.tape import TooLongError
from torchrl_gn.dynamics.executors.native.trace import UntraceableError
from torchrl_gn.dynamics.program import StepProgram
from torchrl_gn.networks.core import ListedCore
from torchrl_gn.networks.graph import Graph
from torchrl_gn.networks.layers import LayerList
from torchrl_gn.networks.snapshot import same

TILE = 24  # samples that stay in a processor's cache from layer to layer
STORED_BYTES = 2**28  # activations' derivatives are kept for the gradient up to this size, else computed again
DTYPES = {torch.float32: 0, torch.float64: 1}  # as the C++ code tells them apart


class NotTracedError(Exception):
    """The state maths have no scalar form; the executor's ``reason`` says why."""


class NativeExecutor:
    """Run the step in C++ on a processor; by torch operations what it cannot: ``reason`` says why.

    State maths in float64, the network in the program's float32 or float64. Differentiable once, in state and action;
    the gradient in a component of the state that cannot move is that of copying it. Results depend neither on the batch
    that a sample is in nor on the number of threads.
    """

    fixed_batch, runs_all = False, True
    change = False  # whether the result is a change instead of the next state

    def __init__(self, program: StepProgram) -> None:
        self.program, self.eager = program, EagerExecutor(program)
        self.network: library.NativeNetwork | None = None
        self.maths: library.NativeMaths | None = None
        self.reason: str | None = None  # why it runs by torch operations
        self._untraceable: str | None = None  # why its state maths has no tape
        self.version, self.pool = 0, library.Pool()
        self.update(program)

    def update(self, program: StepProgram) -> None:
        """Take another program of the same scene: its state maths are traced again only if they differ."""
        self.version += 1
        if not same(_maths_of(self.program), _maths_of(program)):
            self.maths = self._untraceable = None
        self.program, self.eager = program, EagerExecutor(program)
        layers, self.reason = list_layers(program) if self._untraceable is None else (None, self._untraceable)
        self.layers = layers
        if layers is None:
            self.network = None
            return
        # Numbers of a sample and step that its gradient needs: slopes of the activations, and the output.
        sizes = [layer.count * len(layer.weight) for layer in layers.layers]
        slopes = [size for size, layer in zip(sizes, layers.layers, strict=True) if layer.activation is not None]
        self.kept = sum(slopes) + sizes[-1]
        if self.network is not None and self.network.fits(layers, program.dtype):
            self.network = self._packed(self.network, layers)
            return
        self.maths = None
        try:
            self.network = library.NativeNetwork(layers, program.dtype)
        except (library.NoCompilerError, TypeError) as error:
            self.network, self.reason = None, str(error)

    def _packed(self, network: library.NativeNetwork, layers: LayerList) -> library.NativeNetwork:
        """The network with other weights."""
        network.update(layers)
        return network

    def step(self, state: Tensor, action: Tensor, hidden: Graph | None = None) -> tuple[Tensor, Graph | None]:
        if self._runs(state, action):
            try:
                return self._rollout(state, action, False), None
            except NotTracedError:
                pass
        return self.eager.step(state, action, hidden)

    def rollout(self, state: Tensor, actions: Tensor, hidden: Graph | None = None) -> tuple[Tensor, Graph | None]:
        if actions.shape[-2] and self._runs(state, actions):
            try:
                return self._rollout(state, actions, True), None
            except NotTracedError:
                pass
        return rollout_by_steps(self.eager, state, actions, hidden)

    def _runs(self, state: Tensor, action: Tensor) -> bool:
        return (
            self.network is not None
            and state.dtype in DTYPES
            and action.dtype in DTYPES
            and state.is_cpu
            and action.is_cpu
            and state.numel() > 0
            and not torch.compiler.is_compiling()
            and not torch._C._are_functorch_transforms_active()
        )

    def _rollout(self, state: Tensor, actions: Tensor, many: bool) -> Tensor:
        if (state.requires_grad or actions.requires_grad) and torch.is_grad_enabled():
            return _Differentiable.apply(self, state, actions, many)  # pyright: ignore[reportReturnType]
        return self.run(state.contiguous(), actions.contiguous(), many)

    def run(self, state: Tensor, actions: Tensor, many: bool, stored: Tensor | None = None) -> Tensor:
        """The next state for an action ``[*B, A]``; for ``many``, ``[*B, T, A]``, states ``[*B, T + 1, N, C]``."""
        shape, threads = state.shape, torch.get_num_threads()
        size = shape[-2] * shape[-1]
        count = state.numel() // size
        if many:
            steps = actions.shape[-2]
            out = torch.empty((*shape[:-2], steps + 1, *shape[-2:]), dtype=state.dtype)
        else:
            steps, out = 1, torch.empty(shape, dtype=state.dtype)
        call = (
            *(count, steps, tile_of(count, threads), threads),
            *((state.data_ptr(), DTYPES[state.dtype]), size, (actions.data_ptr(), DTYPES[actions.dtype])),
            *((out.data_ptr(), DTYPES[out.dtype]), many, library.NOTHING, library.NOTHING),
            *(None if stored is None else stored.data_ptr(), 0, None, None),
        )
        network = self.network
        assert network is not None
        while self.maths is None or not library.rollout(network, self.maths, call):
            self.trace(state)
        return out

    def prepare(self, states: Tensor) -> None:
        """Trace the state maths, unless they are."""
        if self.maths is None:
            self.trace(states)

    def trace(self, states: Tensor) -> None:
        """Make the state maths for states whose constant channels are those of the first, as far as all have them."""
        assert self.layers is not None
        try:
            before = None if self.maths is None else self.maths.maths
            maths = trace_states(self.program, self.layers, states, before, self.change)
        except (UntraceableError, TooLongError) as error:
            self.network, self.reason = None, str(error)
            self._untraceable = self.reason
            raise NotTracedError from error
        self.maths = library.NativeMaths(maths, self.layers)


class _Differentiable(torch.autograd.Function):
    @staticmethod
    def forward(ctx, executor: NativeExecutor, state: Tensor, actions: Tensor, many: bool) -> Tensor:
        state, actions, network = state.contiguous(), actions.contiguous(), executor.network
        assert network is not None
        steps = actions.shape[-2] if many else 1
        count = state.shape[:-2].numel()
        threads = torch.get_num_threads()
        numbers, stored = count * steps * executor.kept, None
        if numbers * network.number.itemsize <= STORED_BYTES:
            stored = executor.pool.take(numbers, network.number)
        out = executor.run(state, actions, many, None if stored is None else stored.tensor)
        ctx.save_for_backward(out if many else state, actions)
        ctx.stored = stored
        ctx.call, ctx.many = (count, steps, tile_of(count, threads), threads), many
        ctx.executor, ctx.version, ctx.maths = executor, executor.version, executor.maths
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        executor, many, (states, actions) = ctx.executor, ctx.many, ctx.saved_tensors
        if ctx.version != executor.version:
            raise RuntimeError("The model's weights changed between a prediction and its gradient; predict again.")
        gradient, steps, size = gradient.contiguous(), ctx.call[1], states.shape[-2] * states.shape[-1]
        shape = (*states.shape[:-3], *states.shape[-2:]) if many else states.shape
        of_state, of_actions = torch.empty(shape, dtype=states.dtype), torch.empty_like(actions)
        call = (
            *ctx.call,
            *((states.data_ptr(), DTYPES[states.dtype]), size * (steps + 1 if many else 1)),
            *((actions.data_ptr(), DTYPES[actions.dtype]), (gradient.data_ptr(), DTYPES[gradient.dtype]), many),
            *((of_state.data_ptr(), DTYPES[states.dtype]), (of_actions.data_ptr(), DTYPES[actions.dtype])),
            *(None if ctx.stored is None else ctx.stored.tensor.data_ptr(), 0, None, None),
        )
        library.rollout_adjoint(executor.network, ctx.maths, call)
        return None, of_state, of_actions, None


def tile_of(count: int, threads: int) -> int:
    """Samples of a tile, such that there are tiles for all threads."""
    return min(TILE, -(-count // threads))


def list_layers(program: StepProgram) -> tuple[LayerList | None, str | None]:
    """The network as a list of layers, or why it cannot be one."""
    core = program.core
    if program.recurrent is not None:
        return None, "a recurrent model runs by torch operations"
    if program.movable.device.type != "cpu":
        return None, f"on {program.movable.device.type}, it runs by torch operations"
    if program.dtype not in (*DTYPES, torch.bfloat16):
        return None, f"{str(program.dtype).removeprefix('torch.')} products run by torch operations"
    layers = core.layers() if isinstance(core, ListedCore) else None
    if layers is None:
        return None, "a core without a list of layers, or parameters of each sample, run by torch operations"
    return layers, None


def trace_states(
    program: StepProgram, layers: LayerList, states: Tensor, known: StateMaths | None = None, change: bool = False
) -> StateMaths:
    """State maths for states ``[*B, N, C]``: channels are constant that cannot change and are equal in all of them.

    With ``known``, those of its constant channels that have their values in all of ``states``. With ``change``, the
    result is the change instead of the next state.

    Raises:
        UntraceableError: if a feature uses an operation without scalar form.
        TooLongError: if it needs too many registers.
    """
    flat = states.detach().reshape(-1, *states.shape[-2:]).double().numpy()
    if known is None:
        values, constant = flat[0], may_be_constant(program, flat[0])
    else:
        values, constant = known.state, known.is_constant
    constant = constant & (np.abs(flat - values) <= 1e-10 * (1 + np.abs(values))).all(0)
    core, last = program.core, layers.layers[-1]
    assert isinstance(core, ListedCore)
    predicted = torch.arange(layers.nodes[0])[core.predicted].numpy()
    width = last.count * len(last.weight) // max(len(predicted), 1)
    return StateMaths(program, np.where(constant, values, 0.0), constant, predicted, width, change)


def _maths_of(program: StepProgram) -> tuple:
    """All parts of a program but its network."""
    return tuple(getattr(program, field.name) for field in fields(program) if field.name != "core")
