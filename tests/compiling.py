"""Whether this machine can compile steps."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from contextlib import contextmanager

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


@contextmanager
def no_compiler() -> Iterator[None]:
    """As if this machine had no C++ compiler for torch."""
    from torch._inductor import config, cpp_builder

    getattr(cpp_builder.get_cpp_compiler, "cache_clear", lambda: None)()
    with config.patch({"cpp.cxx": ("no-such-compiler",)}):
        yield


compiles = pytest.mark.skipif(not (NEW_TORCH and _has_compiler()), reason="torch cannot compile here")
