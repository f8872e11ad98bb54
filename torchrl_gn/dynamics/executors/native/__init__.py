"""The native executor: state maths as tapes of scalar instructions and the network's layers, run by C++ operators."""

from torchrl_gn.dynamics.executors.native.build import NoCompilerError as NoCompilerError
from torchrl_gn.dynamics.executors.native.executor import NativeExecutor as NativeExecutor
from torchrl_gn.dynamics.executors.native.operators import load_operators as load_operators
