"""Ways to run a :class:`~torchrl_gn.dynamics.program.StepProgram`: one a file, all with one interface."""

from collections.abc import Callable

from torchrl_gn.dynamics.executors.compiled import CompiledExecutor as CompiledExecutor
from torchrl_gn.dynamics.executors.eager import EagerExecutor as EagerExecutor
from torchrl_gn.dynamics.executors.native import NativeExecutor as NativeExecutor
from torchrl_gn.dynamics.program import Executor, StepProgram

EXECUTORS: dict[str, Callable[[StepProgram], Executor]] = {
    "eager": EagerExecutor,
    "compiled": CompiledExecutor,
    "native": NativeExecutor,
}
"""Executors by the names that :func:`~torchrl_gn.dynamics.specialize` takes."""
