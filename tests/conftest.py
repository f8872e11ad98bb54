"""Settings of all tests."""

from __future__ import annotations

import os
import tempfile

import mujoco
import pytest
import torch

# Small tensors gain nothing from more threads, and threads on a busy machine wait for each other.
THREADS = int(os.environ.get("TORCHRL_GN_TEST_THREADS", "1"))
torch.set_num_threads(THREADS)

# The compiler's cache does not tell one processor's code from another's: pretending to have another needs its own.
if capability := os.environ.get("ATEN_CPU_CAPABILITY"):
    cache = os.path.join(tempfile.gettempdir(), f"torchrl_gn_tests_{os.getuid()}_{capability}")
    os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", cache)


def pytest_configure(config: pytest.Config) -> None:
    # An older MuJoCo gives bodies of jaco other principal axes, in the fourth digit, and its trained model says so.
    if tuple(map(int, mujoco.__version__.split(".")[:2])) < (3, 14):
        config.addinivalue_line("filterwarnings", "ignore::torchrl_gn.scenes.SceneChangedWarning")


def pytest_runtest_setup() -> None:
    """Recipes set the number of threads by their options, TorchRL's SerialEnv raises it when it is closed."""
    torch.set_num_threads(THREADS)
