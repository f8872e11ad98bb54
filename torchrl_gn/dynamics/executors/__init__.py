"""Ways to run a :class:`~torchrl_gn.dynamics.program.StepProgram`: one a file, all with one interface."""

from collections.abc import Callable

from torchrl_gn.dynamics.executors.compiled import CompiledExecutor as CompiledExecutor
from torchrl_gn.dynamics.executors.cuda import CudaExecutor as CudaExecutor
from torchrl_gn.dynamics.executors.eager import EagerExecutor as EagerExecutor
from torchrl_gn.dynamics.executors.native import NativeExecutor as NativeExecutor
from torchrl_gn.dynamics.program import Executor, StepProgram


def native_executor(program: StepProgram, *, change: bool = False, live: bool = False) -> NativeExecutor | CudaExecutor:
    """C++ on a processor, CUDA on an NVIDIA GPU.

    Args:
        program: one of those that it is to run.
        change: whether it is to run ``delta`` instead of ``step`` and ``rollout``.
        live: whether every program brings tensors of its own, so that nothing can be recorded.
    """
    if program.movable.is_cuda:
        return CudaExecutor(program, change=change, graphs=not live)
    return NativeExecutor(program, change=change)


def compiled_executor(program: StepProgram) -> CompiledExecutor | CudaExecutor:
    """The whole step compiled; on an NVIDIA GPU kernels for the state maths, where it has them, and the network."""
    if program.movable.is_cuda:
        executor = CudaExecutor(program, compiles=True)
        if executor.reason is None:
            return executor
    return CompiledExecutor(program)


EXECUTORS: dict[str, Callable[[StepProgram], Executor]] = {
    "eager": EagerExecutor,
    "compiled": compiled_executor,
    "native": native_executor,
}
"""Executors by the names that :func:`~torchrl_gn.dynamics.specialize` takes."""
