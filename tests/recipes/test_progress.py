"""Notes that recipes print on a training."""

from __future__ import annotations

import math

import pytest
import torch

from _common.progress import poor_note
from torchrl_gn.evaluation import ErrorTable
from torchrl_gn.evaluation.error_table import PredictionError


def table(**errors: float) -> ErrorTable:
    parts = {name: PredictionError(name, {"position": value}, {}, {}, (), 1, 0) for name, value in errors.items()}
    return ErrorTable(parts, torch.zeros(0))


def test_errors_that_are_no_better_than_rest_are_named():
    tables = {
        "arm": table(one_step_error=0.2, rollout_error_20=0.5),
        "hand": table(one_step_error=0.2, rollout_error_20=3),
    }
    note = poor_note(tables, 1200)
    assert note is not None and "hand (rollout error 20)" in note and "arm" not in note and "1,200 steps" in note


@pytest.mark.parametrize("bad", [1.0, math.inf, math.nan])
def test_what_counts_as_poor(bad):
    assert "arm (one step error)" in (poor_note({"arm": table(one_step_error=bad)}, 5) or "")
    assert poor_note({"arm": table(one_step_error=0.99)}, 5) is None
