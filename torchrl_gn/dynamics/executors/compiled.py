"""Run a step program through ``torch.compile``."""

from __future__ import annotations

import inspect
import logging
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchrl_gn.dynamics.executors import eager
from torchrl_gn.dynamics.program import StepProgram
from torchrl_gn.networks.core import UnfoldedCore
from torchrl_gn.networks.graph import Graph
from torchrl_gn.networks.snapshot import copy_into


class CompiledExecutor:
    """Compile the step and its gradient, at the first call with every new shape and dtype.

    The gradient is one function that computes the step again and pulls the gradient back through it: activations are
    never stored, so memory does not grow with the network over long rollouts. Differentiable once, in state, action and
    hidden state; never in weights.

    Raises:
        FileNotFoundError: without a C++ compiler on a CPU.
        RuntimeError: with a torch before 2.13.
        TypeError: of a core that is evaluated by message passing, or physics outside torch.
    """

    fixed_batch, runs_all = True, False

    def __init__(self, program: StepProgram) -> None:
        check_compiling(program.movable.device)
        if isinstance(program.core, UnfoldedCore):
            kind = type(program.core.core).__name__
            raise TypeError(f"{kind} has no fold() and is evaluated by message passing: use executor='eager'.")
        if program.physics is not None and program.physics.outside:
            raise TypeError("The physics run outside torch, which cannot compile them: use executor='eager'.")
        self.version = 0
        self._load(program)

    def _load(self, program: StepProgram) -> None:
        self.program = program
        run, pull = _functions(program) if program.recurrent is None else _recurrent_functions(program)
        self.run, self.pull = _compile(run), _compile(pull)

    def update(self, program: StepProgram) -> CompiledExecutor:
        """Take another program: without compiling again if only its numbers differ."""
        self.version += 1
        if not copy_into(self.program, program):
            self._load(program)
        return self

    def step(self, state: Tensor, action: Tensor, hidden: Graph | None = None) -> tuple[Tensor, Graph | None]:
        inputs = [state, action]
        if self.program.recurrent is not None:
            hidden = self._start(state, action) if hidden is None else hidden
            inputs += hidden.features
        if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in inputs):
            after, *rest = _Differentiable.apply(self, *inputs)
        else:
            after, *rest = detached(self.run, *inputs)
        return after, Graph(rest[0], rest[1], rest[2], self.program.edge_index) if rest else None

    def rollout(self, state: Tensor, actions: Tensor, hidden: Graph | None = None) -> tuple[Tensor, Graph | None]:
        return eager.rollout_by_steps(self, state, actions, hidden)

    def _start(self, state: Tensor, action: Tensor) -> Graph:
        program = self.program
        assert program.recurrent is not None
        canonical = eager.canonical_state(program, state, action)
        return program.recurrent.start(eager.dynamic_graph(program, canonical, action))


def _functions(program: StepProgram) -> tuple[Callable, Callable]:
    def run(state: Tensor, action: Tensor) -> tuple[Tensor, ...]:
        return (eager.step(program, state, action, None)[0],)

    def pull(state: Tensor, action: Tensor, *gradients: Tensor) -> tuple[Tensor, ...]:
        return torch.func.vjp(run, state, action)[1](gradients)

    return run, pull


def _recurrent_functions(program: StepProgram) -> tuple[Callable, Callable]:
    def run(state: Tensor, action: Tensor, nodes: Tensor, edges: Tensor, globals_: Tensor) -> tuple[Tensor, ...]:
        after, hidden = eager.step(program, state, action, Graph(nodes, edges, globals_, program.edge_index))
        assert hidden is not None
        return after, *hidden.features

    def pull(
        state: Tensor, action: Tensor, nodes: Tensor, edges: Tensor, globals_: Tensor, *gradients: Tensor
    ) -> tuple[Tensor, ...]:
        return torch.func.vjp(run, state, action, nodes, edges, globals_)[1](gradients)

    return run, pull


def detached(function: Callable, *inputs: Tensor) -> Any:
    """Call compiled code: it is compiled anew for inputs with other strides, or of which a gradient is wanted."""
    with torch.no_grad():
        return function(*(tensor.detach().contiguous() for tensor in inputs))


class _Differentiable(torch.autograd.Function):
    @staticmethod
    def forward(ctx, executor: CompiledExecutor, *inputs: Tensor) -> tuple[Tensor, ...]:
        ctx.executor, ctx.version = executor, executor.version
        ctx.save_for_backward(*inputs)
        return detached(executor.run, *inputs)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *gradients: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        if ctx.version != ctx.executor.version:
            raise RuntimeError("The model's weights changed between a prediction and its gradient; predict again.")
        return None, *detached(ctx.executor.pull, *ctx.saved_tensors, *gradients)


def _compile(function: Callable) -> Callable:
    # Small linear systems are solved through Python's fallback, of which the compiler warns.
    logging.getLogger("torch._inductor.ir").addFilter(_is_worth_showing)
    options: dict[str, Any] = {"guard_filter_fn": partial(_input_guards, inspect.signature(function).parameters)}
    if not torch.cuda.is_available():
        # The kernels of a small graph take less time than calling them from Python.
        options["cpp_wrapper"] = True
    limits: dict[str, Any] = {"recompile_limit": 1000, "isolate_recompiles": True}  # type checkers know no overload
    return torch.compile(function, fullgraph=True, dynamic=False, options=options, **limits)


def _input_guards(inputs: Collection[str], guards: Sequence[Any]) -> list[bool]:
    """Check at each call only shapes, dtypes and devices of the inputs.

    All else that the function reads belongs to one program; checking it takes longer than a step of a small graph.
    """
    return [guard.guard_type == "TENSOR_MATCH" and guard.name in inputs for guard in guards]


def _is_worth_showing(record: logging.LogRecord) -> bool:
    return "missing a c-shim implementation" not in record.getMessage()


def check_compiling(device: torch.device) -> None:
    """RuntimeError if torch is too old to compile, FileNotFoundError without a C++ compiler on a CPU."""
    # Only inputs are guarded, so two programs of equal shapes must not share compiled code.
    if "isolate_recompiles" not in inspect.signature(torch.compile).parameters:
        raise RuntimeError(f"compiling needs torch 2.13 or newer, not {torch.__version__}: run eagerly.")
    if device.type == "cpu":
        check_compiler()


def check_compiler() -> None:
    """FileNotFoundError without a C++ compiler."""
    from torch._inductor.cpp_builder import get_cpp_compiler
    from torch._inductor.exc import InvalidCxxCompiler

    try:
        get_cpp_compiler()
    except InvalidCxxCompiler as error:
        raise FileNotFoundError("compiling needs a C++ compiler: install g++, or run eagerly.") from error
