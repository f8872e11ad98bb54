"""The compiled operators ``torch.ops.torchrl_gn``."""

from __future__ import annotations

import functools
import os
import shlex
from ctypes import CDLL
from pathlib import Path
from typing import Any

import torch

from torchrl_gn.dynamics.executors.native.build import NoCompilerError, instruction_flags, load
from torchrl_gn.processor import processor_flags, processor_name


def load_operators() -> Any:
    """Return ``torch.ops.torchrl_gn``; the first use on a processor builds it in ``~/.cache/torchrl_gn`` (a minute).

    Raises:
        NoCompilerError: without a working C++ compiler (``CXX``, which may have arguments, else c++, g++ or clang++).
    """
    operators = _operators_or_reason()
    if isinstance(operators, str):
        raise NoCompilerError(operators)
    return operators


@functools.cache
def _operators_or_reason() -> Any:
    try:
        root = Path(torch.__file__).parent
        abi = int(torch.compiled_with_cxx11_abi())
        torch_options = [f"-I{root / part}" for part in ("include", "include/torch/csrc/api/include")]
        torch_options += ["-O2", "-w", f"-D_GLIBCXX_USE_CXX11_ABI={abi}"]
        extra_flags = shlex.split(os.environ.get("TORCHRL_GN_CXXFLAGS", ""))
        options = ["-std=c++20", "-fPIC", "-ffp-contract=fast", "-fno-math-errno", "-pthread", *instruction_flags()]
        sources = {
            "engine.cpp": [*options, "-O3", *extra_flags],
            "operators.cpp": [*options, *torch_options, *extra_flags],
        }
        link = [*extra_flags, f"-L{root / 'lib'}", "-ltorch_cpu", "-lc10"]
        parts = (processor_name(), processor_flags(), torch.__version__)
        load("operators", "the native executor", sources, link, parts, lambda file: CDLL(str(file)))
        return torch.ops.torchrl_gn
    except (OSError, ValueError) as error:
        return str(error)
