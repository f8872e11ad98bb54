"""Options are checked in one way."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_gn.checks import checked_seed
from torchrl_gn.data.controls import numpy_generator
from torchrl_gn.data.replay import WindowSampler


@pytest.mark.parametrize("seed", [0, 2**63 - 1, np.int64(7), np.uint8(7)])
def test_whole_numbers_are_seeds(seed):
    assert type(checked_seed(seed)) is int and checked_seed(seed) == seed
    torch.Generator().manual_seed(checked_seed(seed))
    assert numpy_generator(seed).random() == np.random.default_rng(int(seed)).random()


@pytest.mark.parametrize("seed", [True, 1.5, 1.0, -1, 2**63, "1", np.bool_(True), np.float64(1), torch.tensor(1)])
def test_other_seeds_are_refused_by_name(seed):
    for use in (checked_seed, numpy_generator, lambda seed: WindowSampler(seed=seed)):
        with pytest.raises(ValueError, match="seed=.* must be a whole number from 0 to"):
            use(seed)
