from __future__ import annotations

import pytest

from torchrl_gn.training import Budget


def test_steps_count_steps_and_minutes_count_minutes():
    assert Budget(steps=200).fraction(50, 1e9) == 0.25
    assert Budget(minutes=2).fraction(10**9, 30) == 0.25
    for budget in (Budget(steps=200), Budget(minutes=2)):
        assert budget.fraction(0, 0.0) == 0
        assert budget.fraction(200, 120.0) == budget.fraction(300, 1e4) == 1


@pytest.mark.parametrize("limits", [{}, {"steps": 3, "minutes": 1.0}])
def test_exactly_one_limit(limits):
    with pytest.raises(ValueError, match="Give either steps or minutes, not steps="):
        Budget(**limits)


@pytest.mark.parametrize("limits", [{"steps": 0}, {"steps": -1}, {"minutes": 0.0}])
def test_limits_are_positive(limits):
    with pytest.raises(ValueError, match="must be positive and finite, got"):
        Budget(**limits)
