"""Settings of all tests."""

from __future__ import annotations

import os

import torch

# Small tensors gain nothing from more threads, and threads on a busy machine wait for each other.
torch.set_num_threads(int(os.environ.get("TORCHRL_GN_TEST_THREADS", "1")))
