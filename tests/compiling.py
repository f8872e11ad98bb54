"""Whether this machine can compile steps."""

from __future__ import annotations

import inspect

import pytest
import torch

from torchrl_gn.dynamics.executors.compiled import check_compiler

NEW_TORCH = "isolate_recompiles" in inspect.signature(torch.compile).parameters


def _has_compiler() -> bool:
    try:
        check_compiler()
    except FileNotFoundError:
        return False
    return True


compiles = pytest.mark.skipif(not (NEW_TORCH and _has_compiler()), reason="torch cannot compile here")
