"""Run a step program in compiled C++: whole rollouts, and their gradients, in one call."""

from __future__ import annotations

import copy
from dataclasses import fields
from typing import NamedTuple, Self

import torch
from torch import Tensor

from torchrl_gn.dynamics.executors.eager import EagerExecutor
from torchrl_gn.dynamics.executors.native import library
from torchrl_gn.dynamics.executors.native.build import NoCompilerError
from torchrl_gn.dynamics.executors.native.pool import Pool
from torchrl_gn.dynamics.executors.native.samples import ParameterInputs, Samples, batch_of
from torchrl_gn.dynamics.executors.native.trace import UntraceableError
from torchrl_gn.dynamics.executors.native.traced_program import MixedStatesError, TracedProgram
from torchrl_gn.dynamics.program import StepProgram
from torchrl_gn.dynamics.watched import version_of
from torchrl_gn.networks.core import ListedCore
from torchrl_gn.networks.graph import Graph
from torchrl_gn.networks.layers import LayerList
from torchrl_gn.networks.linear import needs_plain_operations
from torchrl_gn.networks.snapshot import same

STORED_BYTES = 2**28  # activations' derivatives are kept for the gradient up to this size, else computed again
_TYPES = (Tensor, torch.nn.Parameter)


class NativeExecutor:
    """Run the step in C++ on a processor; by torch operations what it cannot: ``reason`` says why.

    State maths in float64, the network in the program's float32 or float64. Differentiable once, in state and action;
    the gradient in a component of the state that cannot move is that of copying it. Results depend neither on the batch
    that a sample is in nor on the number of threads; with parameters of each sample, which torch folds, they do by
    rounding. Several threads may run it at once.
    """

    fixed_batch, runs_all = False, True
    change = False  # whether the result is a change instead of the next state

    def __init__(self, program: StepProgram) -> None:
        self.pool = Pool()
        self.shared = {"version": 0}  # of the weights; with executors that update() made
        self._last: Native | None = None  # and the state maths and physical parameters that it was traced for
        self._maths: tuple = ()
        self._parameters: ParameterInputs | None = None
        self._load(program)

    @property
    def reason(self) -> str | None:
        """Why it runs by torch operations; None if it runs natively."""
        return self._reason if self.native is None else self.native.traced.reason

    def update(self, program: StepProgram) -> Self:
        """What runs another program of the same scene: its state maths are traced again only if they differ.

        This executor still runs its own, for other threads.
        """
        other = copy.copy(self)
        other._load(program)
        return other

    def _load(self, program: StepProgram) -> None:
        self.program, self.eager, self.native = program, EagerExecutor(program), None
        batch = batch_of(program.parameters)
        if self.change and batch:
            layers, self._reason = None, "with parameters of each sample, training runs by torch operations"
        elif not batch.numel():
            layers, self._reason = None, "there is no sample"
        else:
            layers, self._reason = list_layers(program)
        if layers is None:
            return
        try:
            network = library.NativeNetwork(layers, program.dtype)
        except (NoCompilerError, TypeError) as error:
            self._reason = str(error)
            return
        before, maths = self._last, _maths_of(program)
        same_maths = same(self._maths, maths)
        inputs = ParameterInputs.of(program.parameters, self._parameters if same_maths else None)
        if before is not None and not before.network.equals(network):
            before = None
        if before is not None and same_maths and inputs is self._parameters:
            traced = before.traced
        else:
            traced = TracedProgram(program, layers, inputs, self.change)
        if before is None or not before.network.same_weights(network):
            self.shared["version"] += 1
        samples = Samples.of(layers, inputs.read(program.parameters), network.number)
        self._maths, self._parameters = maths, inputs
        self.native = self._last = Native(network, layers, traced, samples, self.shared["version"])

    def step(self, state: Tensor, action: Tensor, hidden: Graph | None = None) -> tuple[Tensor, Graph | None]:
        if (native := self.running(state, action)) is not None:
            after = self._rollout(native, state, action, False)
            if after is not None:
                return after, None
        return self.eager.step(state, action, hidden)

    def rollout(self, state: Tensor, actions: Tensor, hidden: Graph | None = None) -> tuple[Tensor, Graph | None]:
        if actions.shape[-2] and (native := self.running(state, actions)) is not None:
            states = self._rollout(native, state, actions, True)
            if states is not None:
                return states, None
        return self.eager.rollout(state, actions, hidden)

    def running(self, state: Tensor, action: Tensor) -> Native | None:
        """What runs inputs natively; None if torch must."""
        native = self.native
        runs = (
            native is not None
            and native.traced.reason is None
            and type(state) in _TYPES
            and type(action) in _TYPES
            and state.dtype in library.DTYPES
            and action.dtype in library.DTYPES
            and state.is_cpu
            and action.is_cpu
            and state.numel() > 0
            and native.samples.count in (None, state.shape[:-2].numel())
            and not needs_plain_operations()
            and not torch._C._len_torch_dispatch_stack()  # a mode that must see every operation
            and torch._C._get_tracing_state() is None  # of torch.jit.trace
        )
        return native if runs else None

    def _rollout(self, native: Native, state: Tensor, actions: Tensor, many: bool) -> Tensor | None:
        """The next state for an action ``[*B, A]``; for ``many``, ``[*B, T, A]``, states ``[*B, T + 1, N, C]``.

        None if torch operations must run it.
        """
        try:
            if (state.requires_grad or actions.requires_grad) and torch.is_grad_enabled():
                return _Differentiable.apply(self, native, state, actions, many)  # pyright: ignore[reportReturnType]
            return _run(native, state.contiguous(), actions.contiguous(), many)[0]
        except MixedStatesError as mixed:
            groups = mixed.groups
        except UntraceableError:
            return None
        states = state.reshape(-1, *state.shape[-2:])
        actions = actions.reshape(len(groups), *actions.shape[state.ndim - 2 :])
        places = [(groups == group).nonzero().flatten() for group in groups.unique().tolist()]
        parts: list[Tensor] = []
        for at in places:
            of_group = native._replace(samples=native.samples.part(at))
            part = self._rollout(of_group, states[at], actions[at], many)
            if part is None and native.samples.count is not None:
                return None
            by_torch = self.eager.rollout if many else self.eager.step
            parts.append(by_torch(states[at], actions[at])[0] if part is None else part)
        out = torch.cat(parts)[torch.cat(places).argsort()]
        return out.view(*state.shape[:-2], *out.shape[1:])


class Native(NamedTuple):
    """A network and the state maths around it."""

    network: library.NativeNetwork
    layers: LayerList
    traced: TracedProgram
    samples: Samples
    version: int  # of the weights


def _run(
    native: Native, state: Tensor, actions: Tensor, many: bool, stored: Tensor | None = None
) -> tuple[Tensor, library.Call, library.NativeMaths]:
    """Results for contiguous inputs, and what a gradient needs: the call, and its state maths.

    Raises:
        MixedStatesError: if the samples need different state maths.
        UntraceableError: if torch operations must run it.
    """
    call, out = library.forward_call(state, actions, many, stored)
    native.samples.bring(call)
    return out, call, native.traced.run(native.network, call, state, actions)


class _Differentiable(torch.autograd.Function):
    @staticmethod
    def forward(ctx, executor: NativeExecutor, native: Native, state: Tensor, actions: Tensor, many: bool) -> Tensor:
        state, actions, network = state.contiguous(), actions.contiguous(), native.network
        numbers = state.shape[:-2].numel() * (actions.shape[-2] if many else 1) * network.kept
        stored = None
        if numbers * network.number.itemsize <= STORED_BYTES:
            stored = executor.pool.take(numbers, network.number)
        out, ctx.call, ctx.maths = _run(native, state, actions, many, None if stored is None else stored.tensor)
        ctx.save_for_backward(out if many else state, actions)
        ctx.executor, ctx.native, ctx.stored = executor, native, stored
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        states, actions = ctx.saved_tensors
        if ctx.native.version != ctx.executor.shared["version"]:
            raise RuntimeError("The model's weights changed between a prediction and its gradient; predict again.")
        gradient = gradient.contiguous()  # to live until the call is done
        stored = None if ctx.stored is None else ctx.stored.tensor
        call, of_state, of_actions = library.adjoint_call(ctx.call, states, actions, gradient, stored)
        library.rollout_adjoint(ctx.native.network, ctx.maths, call)
        return None, None, of_state, of_actions, None


def list_layers(program: StepProgram) -> tuple[LayerList | None, str | None]:
    """The network as a list of layers, or why it cannot be one."""
    core = program.core
    if program.recurrent is not None:
        return None, "a recurrent model runs by torch operations"
    if program.physics is not None and program.physics.outside:
        return None, "its physics run outside, so it runs by torch operations"
    if program.movable.device.type != "cpu":
        return None, f"on {program.movable.device.type}, it runs by torch operations"
    if program.dtype not in (*library.DTYPES, torch.bfloat16):
        return None, f"{str(program.dtype).removeprefix('torch.')} products run by torch operations"
    if not isinstance(core, ListedCore):
        return None, "a core without fold() and layers() runs by torch operations"
    if (layers := core.layers()) is None:
        return None, "a core with dynamic globals runs by torch operations"
    return layers, None


def _maths_of(program: StepProgram) -> tuple:
    """Parts of a program beside network and physical parameters, and how often the physics' tensors were changed."""
    parts = tuple(getattr(program, field.name) for field in fields(program) if field.name not in ("core", "parameters"))
    known = () if program.physics is None else (*program.physics.parameters(), *program.physics.buffers())
    return *parts, *map(version_of, known)
