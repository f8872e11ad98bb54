"""The native executor: state maths as tapes of scalar instructions and the network's layers, run by C++."""

from torchrl_gn.dynamics.executors.native.build import NoCompilerError as NoCompilerError
from torchrl_gn.dynamics.executors.native.executor import NativeExecutor as NativeExecutor
from torchrl_gn.dynamics.executors.native.muon import muon_update as muon_update
from torchrl_gn.dynamics.executors.native.training import NativeDelta as NativeDelta
