"""Where random numbers come from."""

from __future__ import annotations

import numpy as np
import torch


def numpy_generator(seed: int | None) -> np.random.Generator:
    """NumPy generator of a seed.

    Args:
        seed: the seed. None: one drawn from torch's global generator, so that ``torch.manual_seed`` makes runs repeat.
    """
    return np.random.default_rng(int(torch.randint(2**31, ()).item()) if seed is None else seed)
