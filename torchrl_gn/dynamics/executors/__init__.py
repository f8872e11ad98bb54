"""Executors of a :class:`~torchrl_gn.dynamics.program.StepProgram`, all with one interface."""

from collections.abc import Callable

from torchrl_gn.dynamics.executors.compiled import CompiledExecutor as CompiledExecutor
from torchrl_gn.dynamics.executors.cuda import CudaExecutor as CudaExecutor
from torchrl_gn.dynamics.executors.eager import EagerExecutor as EagerExecutor
from torchrl_gn.dynamics.executors.native import NativeExecutor as NativeExecutor
from torchrl_gn.dynamics.program import Executor, StepProgram


def native_executor(program: StepProgram, *, change: bool = False, live: bool = False) -> NativeExecutor | CudaExecutor:
    """Make the native executor: C++ on a CPU, CUDA on an NVIDIA GPU.

    Args:
        program: any of the programs to run.
        change: whether to run ``delta`` instead of ``step`` and ``rollout``.
        live: True if each program has new tensors, which rules out recording steps as CUDA graphs.
    """
    if program.movable.is_cuda:
        return CudaExecutor(program, change=change, graphs=not live)
    return NativeExecutor(program, change=change)


def compiled_executor(program: StepProgram) -> CompiledExecutor | CudaExecutor:
    """Make the compiled executor; on an NVIDIA GPU it compiles only the network if kernels can run the state maths."""
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
