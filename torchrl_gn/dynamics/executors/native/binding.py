"""Call a single step, and its gradient, without ctypes, where torch's and Python's headers are there to build it."""

from __future__ import annotations

import ctypes
import functools
import importlib.util
import sys
import sysconfig
from importlib.machinery import ExtensionFileLoader
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from torchrl_gn.dynamics.executors.native import build, library
from torchrl_gn.dynamics.executors.native.executor import NativeExecutor

if TYPE_CHECKING:
    from torchrl_gn.dynamics.program import Executor
    from torchrl_gn.dynamics.watched import Watched
    from torchrl_gn.scenes import Scene

_NAME = "torchrl_gn_binding"


@functools.cache
def load_binding() -> Any:
    """The extension module, built at the first use and kept; None if it cannot be built: ctypes does its work."""
    root = Path(torch.__file__).parent
    headers = [root / "include", root / "include/torch/csrc/api/include", Path(sysconfig.get_paths()["include"])]
    if sys.platform != "linux" or not (headers[0] / "ATen").is_dir() or not (headers[2] / "Python.h").is_file():
        return None
    abi = int(torch.compiled_with_cxx11_abi())
    options = ["-std=c++20", "-O2", "-fPIC", "-shared", "-w", f"-D_GLIBCXX_USE_CXX11_ABI={abi}"]
    options += [*(f"-I{each}" for each in headers), f"-L{root / 'lib'}", "-ltorch_python", "-ltorch_cpu", "-lc10"]
    try:
        return build.load("binding.cpp", "single steps", options, (torch.__version__, sys.version), _opened)
    except (OSError, ImportError, ValueError):
        return None


def _opened(file: Path) -> Any:
    loader = ExtensionFileLoader(_NAME, str(file))
    spec = importlib.util.spec_from_file_location(_NAME, file, loader=loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    return module


def make_plan(executor: Executor, scene: Scene, watched: Watched, casts: int, attributes: dict) -> Any:
    """What ``load_binding().step`` takes with a state and an action; None if the executor cannot run such a step yet.

    The step gives None, and the general way must predict, once a ``watched`` tensor or ``attributes["casts"]`` changes.
    """
    if not isinstance(executor, NativeExecutor):
        return None
    native = executor.native
    if native is None or native.traced.reason is not None or not native.traced.special or not watched.tensors:
        return None
    if not native.samples.empty:  # a plan brings nothing beside state and action
        return None
    if (binding := load_binding()) is None:
        return None
    network, maths = native.network, native.traced.special[0]
    code = network.library
    functions = (ctypes.cast(each, ctypes.c_void_p).value for each in (code.gn_rollout, code.gn_rollout_adjoint))
    return binding.make_plan(
        (native, maths),
        maths.add_adjoint,
        executor.shared,
        native.version,
        attributes,
        casts,
        watched.owners,
        watched.names,
        watched.tensors,
        watched.versions,
        *functions,
        network.pointer,
        network.kind,
        network.kept,
        maths.reference,
        library.TILE,
        scene.num_nodes,
        scene.state_size,
        scene.num_actions,
    )
