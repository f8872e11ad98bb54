"""Settings of all tests."""

from __future__ import annotations

import os

import mujoco
import pytest
import torch

# Small tensors gain nothing from more threads, and threads on a busy machine wait for each other.
torch.set_num_threads(int(os.environ.get("TORCHRL_GN_TEST_THREADS", "1")))


def pytest_configure(config: pytest.Config) -> None:
    # The shipped models were trained on what MuJoCo 3.17 makes of their scenes; others differ in flags, and say so.
    if tuple(map(int, mujoco.__version__.split(".")[:2])) < (3, 14):
        config.addinivalue_line("filterwarnings", "ignore::torchrl_gn.scenes.SceneChangedWarning")
