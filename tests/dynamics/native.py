"""Helpers of the native executor's tests."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import torch

from torchrl_gn.dynamics import Predictor
from torchrl_gn.dynamics.executors.native import NoCompilerError
from torchrl_gn.dynamics.executors.native.operators import load_operators

ROOT = Path(__file__).parents[2]


def _has_compiler() -> bool:
    try:
        load_operators()
    except NoCompilerError:
        return False
    return True


with_compiler = pytest.mark.skipif(not _has_compiler(), reason="there is no C++ compiler")


def vjp(predictor: Predictor, state, actions, parameters=None) -> list[torch.Tensor]:
    """States of a rollout, and gradients of a function of them."""
    leaves = [each.detach().clone().requires_grad_() for each in (state, actions)]
    states = predictor.rollout(*leaves, parameters)[0]
    weights = torch.linspace(-1, 1, states[0].numel(), dtype=states.dtype).view(states.shape[1:])
    return [states.detach(), *torch.autograd.grad((states * weights).sum(), leaves)]


def equal(found, expected) -> bool:
    return all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


def run(code: str, *arguments, check: bool = True, **variables) -> subprocess.CompletedProcess:
    """Run Python code in another process."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", **variables}
    command = [sys.executable, "-c", textwrap.dedent(code), *map(str, arguments)]
    return subprocess.run(command, check=check, capture_output=True, text=True, cwd=ROOT, env=environment)
