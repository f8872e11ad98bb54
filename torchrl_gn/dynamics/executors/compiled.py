"""One prediction step and its gradient, compiled."""

from __future__ import annotations

import inspect
import logging
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

Step = Callable[[Tensor, Tensor], Tensor]


class CompiledStep:
    """``step(state, action) -> next_state`` through ``torch.compile``, once for every shape and dtype.

    The gradient is compiled too, as one function that computes the step again and pulls the
    gradient back through it: activations are never stored, so memory does not grow with the
    network over long rollouts.

    Args:
        step: what to compile; differentiable by :func:`torch.func.vjp`.
        stamp: value that changes when the function does. A gradient through a step whose function
            has changed since is refused.

    Raises:
        FileNotFoundError: without a C++ compiler on a CPU.
    """

    def __init__(self, step: Step, stamp: Callable[[], int]) -> None:
        self.stamp = stamp

        def pull(state: Tensor, action: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
            return torch.func.vjp(step, state, action)[1](gradient)

        self._step, self._pull = _compile(step), _compile(pull)

    def __call__(self, state: Tensor, action: Tensor) -> Tensor:
        """Next state, differentiable once in state and action."""
        if torch.is_grad_enabled() and (state.requires_grad or action.requires_grad):
            return _Differentiable.apply(self, state, action)
        return self._run(self._step, state, action)

    @staticmethod
    def _run(function: Callable, *inputs: Tensor) -> Any:
        # torch.compile compiles anew for inputs with other strides, or of which a gradient is wanted.
        with torch.no_grad():
            return function(*(tensor.detach().contiguous() for tensor in inputs))


class _Differentiable(torch.autograd.Function):
    @staticmethod
    def forward(ctx, compiled: CompiledStep, state: Tensor, action: Tensor) -> Tensor:
        ctx.compiled, ctx.stamp = compiled, compiled.stamp()
        ctx.save_for_backward(state, action)
        return compiled._run(compiled._step, state, action)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        if ctx.stamp != ctx.compiled.stamp():
            raise RuntimeError("The model's weights changed between a prediction and its gradient; predict again.")
        return None, *ctx.compiled._run(ctx.compiled._pull, *ctx.saved_tensors, gradient)


def _compile(function: Callable) -> Callable:
    # Small linear systems are solved through Python's fallback; the user need not know.
    logging.getLogger("torch._inductor.ir").addFilter(_is_news)
    options: dict[str, Any] = {"guard_filter_fn": partial(_guards_of_inputs, inspect.signature(function).parameters)}
    if not torch.cuda.is_available():
        # The kernels of a small graph take less time than calling them from Python.
        options["cpp_wrapper"] = True
    limits: dict[str, Any] = {"recompile_limit": 1000, "isolate_recompiles": True}  # type checkers know no overload
    return torch.compile(function, fullgraph=True, dynamic=False, options=options, **limits)


def _guards_of_inputs(inputs: Collection[str], guards: Sequence[Any]) -> list[bool]:
    """Which of what was true when compiling is checked at each call: shapes, dtypes and devices of the inputs.

    All else that the function reads belongs to one model and one snapshot; to look through it takes longer than a
    step of a small graph.
    """
    return [guard.guard_type == "TENSOR_MATCH" and guard.name in inputs for guard in guards]


def _is_news(record: logging.LogRecord) -> bool:
    return "missing a c-shim implementation" not in record.getMessage()


def check_torch() -> None:
    """Refuse to compile with a torch that is too old.

    Of a step only the inputs are guarded, so two models of equal shapes must not share compiled code, as they do
    without ``isolate_recompiles``. Such a torch cannot compile TorchRL's losses either (tried with 2.7).

    Raises:
        RuntimeError: if it is too old.
    """
    if "isolate_recompiles" not in inspect.signature(torch.compile).parameters:
        raise RuntimeError(f"compile=True needs torch 2.13 or newer, not {torch.__version__}: leave compile out.")


def check_compiler() -> None:
    """Refuse to compile for a CPU without a C++ compiler, before anything is waited for.

    Raises:
        FileNotFoundError: if there is none.
    """
    from torch._inductor.cpp_builder import get_cpp_compiler
    from torch._inductor.exc import InvalidCxxCompiler

    try:
        get_cpp_compiler()
    except InvalidCxxCompiler as error:
        raise FileNotFoundError("compile=True needs a C++ compiler: install g++, or leave compile out.") from error
