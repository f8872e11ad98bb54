"""Settings of all tests."""

from __future__ import annotations

import torch

# Small tensors gain nothing from more threads, and threads on a busy machine wait for each other.
torch.set_num_threads(1)
