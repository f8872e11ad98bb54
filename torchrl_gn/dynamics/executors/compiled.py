"""Run a step program through ``torch.compile``."""

from __future__ import annotations

import inspect
import logging
import operator
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchrl_gn.cache import keep_inductor_private
from torchrl_gn.dynamics.executors import eager
from torchrl_gn.dynamics.program import StepProgram
from torchrl_gn.networks.core import UnfoldedCore
from torchrl_gn.networks.graph import Graph
from torchrl_gn.networks.tensor_tree import leaves, rebuild, skeleton


class CompiledExecutor:
    """Executor that compiles the step and its gradient, at the first call with every new shape and dtype.

    The gradient function recomputes the step and backpropagates through it. Activations are never stored, so the memory
    of long rollouts does not grow with the network. Differentiable once, in state, action and hidden state; never in
    weights.

    Raises:
        FileNotFoundError: without a C++ compiler on a CPU.
        RuntimeError: with torch before 2.13.
        TypeError: if the core is evaluated by message passing, or the physics run outside torch.
    """

    fixed_batch = True
    reason: str | None = None

    def __init__(self, program: StepProgram) -> None:
        check_compiling(program.movable.device)
        if isinstance(program.core, UnfoldedCore):
            why = program.core.reason or f"{type(program.core.core).__name__} has no fold()"
            raise TypeError(f"{why}, and is evaluated by message passing: use executor='eager'.")
        if program.physics is not None and program.physics.outside:
            raise TypeError("The physics run outside torch, which cannot compile them: use executor='eager'.")
        self._compiled: _Compiled | None = None

    def __getstate__(self) -> dict:
        return {"_compiled": None}  # a copy compiles again

    def pack(self, program: StepProgram) -> StepProgram:
        return program

    def step(
        self, program: StepProgram, state: Tensor, action: Tensor, hidden: Graph | None = None
    ) -> tuple[Tensor, Graph | None]:
        inputs = [state, action]
        if program.recurrent is not None:
            hidden = _start(program, state, action) if hidden is None else hidden
            inputs += hidden.features
        if self._compiled is None or not self._compiled.runs(program):
            self._compiled = _Compiled(program)
        functions, tensors = self._compiled, [leaf for _, leaf in leaves(program) if isinstance(leaf, Tensor)]
        if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in inputs):
            after, *graph_parts = _Differentiable.apply(functions, len(inputs), *inputs, *tensors)
        else:
            after, *graph_parts = detached(functions.run, *inputs, *tensors)
        return after, Graph(graph_parts[0], graph_parts[1], graph_parts[2], program.edge_index) if graph_parts else None

    def rollout(
        self, program: StepProgram, state: Tensor, actions: Tensor, hidden: Graph | None = None
    ) -> tuple[Tensor, Graph | None]:
        states = [state]
        for action in actions.unbind(-2):
            state, hidden = self.step(program, state, action, hidden)
            states.append(state)
        return torch.stack(states, dim=-3), hidden


def _start(program: StepProgram, state: Tensor, action: Tensor) -> Graph:
    """Return the initial hidden state of a recurrent program."""
    assert program.recurrent is not None
    canonical = eager.canonical_state(program, state, action)
    return program.recurrent.start(eager.dynamic_graph(program, canonical, action))


class _Compiled:
    """Compiled functions of state, action, hidden features and a program's tensors; its modules are constants."""

    def __init__(self, program: StepProgram) -> None:
        self._modules = [leaf for _, leaf in leaves(program) if not isinstance(leaf, Tensor)]
        tree, kinds = skeleton(program), [isinstance(leaf, Tensor) for _, leaf in leaves(program)]
        modules, dynamic = self._modules, 2 if program.recurrent is None else 5

        def run(*inputs: Tensor) -> tuple[Tensor, ...]:
            tensors, others = iter(inputs[dynamic:]), iter(modules)
            now: StepProgram = rebuild(tree, (next(tensors) if kind else next(others) for kind in kinds))
            hidden = None if dynamic == 2 else Graph(inputs[2], inputs[3], inputs[4], now.edge_index)
            after, hidden = eager.step(now, inputs[0], inputs[1], hidden)
            return (after,) if hidden is None else (after, *hidden.features)

        def vjp(*inputs: Tensor) -> tuple[Tensor, ...]:
            count = len(kinds) - len(modules)
            end = len(inputs) - count  # dynamic inputs, gradients, tensors
            constants = inputs[end:]
            return torch.func.vjp(lambda *some: run(*some, *constants), *inputs[:dynamic])[1](inputs[dynamic:end])

        self.run, self.vjp = _compile(run), _compile(vjp)

    def runs(self, program: StepProgram) -> bool:
        """Return True if the program has the modules that were compiled in."""
        modules = [leaf for _, leaf in leaves(program) if not isinstance(leaf, Tensor)]
        return len(modules) == len(self._modules) and all(map(operator.is_, modules, self._modules))


def detached(function: Callable, *inputs: Tensor) -> Any:
    """Call compiled code with detached, contiguous inputs: it would recompile for gradients and for other strides."""
    with torch.no_grad():
        return function(*(tensor.detach().contiguous() for tensor in inputs))


class _Differentiable(torch.autograd.Function):
    @staticmethod
    def forward(ctx, functions: _Compiled, count: int, *inputs: Tensor) -> tuple[Tensor, ...]:
        ctx.functions, ctx.count = functions, count
        ctx.save_for_backward(*inputs)
        return detached(functions.run, *inputs)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *gradients: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        inputs, tensors = ctx.saved_tensors[: ctx.count], ctx.saved_tensors[ctx.count :]
        input_gradients = detached(ctx.functions.vjp, *inputs, *gradients, *tensors)
        return None, None, *input_gradients, *(None for _ in tensors)


def _compile(function: Callable) -> Callable:
    # The compiler warns that it solves small linear systems by a fallback in Python.
    logging.getLogger("torch._inductor.ir").addFilter(_is_worth_showing)
    keep_inductor_private()
    options: dict[str, Any] = {"guard_filter_fn": _input_guards}
    if not torch.cuda.is_available():
        # The kernels of a small graph take less time than calling them from Python.
        options["cpp_wrapper"] = True
    limits: dict[str, Any] = {"recompile_limit": 1000, "isolate_recompiles": True}  # type checkers know no overload
    return torch.compile(function, fullgraph=True, dynamic=False, options=options, **limits)


def _input_guards(guards: Sequence[Any]) -> list[bool]:
    """Keep only guards on the shapes, dtypes and devices of the inputs.

    All else that the function reads is fixed by its structure; checking it takes longer than a step of a small graph.
    """
    return [guard.guard_type == "TENSOR_MATCH" and guard.name.startswith("inputs") for guard in guards]


def _is_worth_showing(record: logging.LogRecord) -> bool:
    return "missing a c-shim implementation" not in record.getMessage()


def check_compiling(device: torch.device) -> None:
    """Raise RuntimeError if torch is too old to compile, FileNotFoundError without a C++ compiler on a CPU."""
    # Only inputs are guarded, so two programs of equal shapes must not share compiled code.
    if "isolate_recompiles" not in inspect.signature(torch.compile).parameters:
        raise RuntimeError(f"compiling needs torch 2.13 or newer, not {torch.__version__}: run eagerly.")
    if device.type == "cpu":
        check_compiler()


def check_compiler() -> None:
    """Raise FileNotFoundError without a C++ compiler."""
    from torch._inductor.cpp_builder import get_cpp_compiler
    from torch._inductor.exc import InvalidCxxCompiler

    try:
        get_cpp_compiler()
    except InvalidCxxCompiler as error:
        raise FileNotFoundError("compiling needs a C++ compiler: install g++, or run eagerly.") from error
