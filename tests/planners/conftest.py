"""Helpers of tests of control in an ensemble."""

from __future__ import annotations

import pytest
import torch

from torchrl_gn.dynamics import BoundEnsemble, Ensemble


@pytest.fixture
def ensemble(scenes, make_model) -> BoundEnsemble:
    """Calibrated: its doubt is the members' spread, by 0.01 in every component."""
    made = Ensemble([make_model(scenes["cheetah"], seed=seed) for seed in range(3)])
    size = (1, len(made.models[0].layout.names))
    made.calibration.set(torch.ones(size), torch.zeros(size), torch.full(size[1:], 0.01))
    return made.bind(scenes["cheetah"])
