"""Spent shares of a budget of steps, minutes or both, with windows."""

from __future__ import annotations

import pytest

from torchrl_gn.training import Budget


def test_steps_count_steps_and_minutes_count_minutes():
    assert Budget(steps=200).fraction(50, 1e9) == 0.25
    assert Budget(minutes=2).fraction(10**9, 30) == 0.25
    for budget in (Budget(steps=200), Budget(minutes=2)):
        assert budget.fraction(0, 0.0) == 0
        assert budget.fraction(200, 120.0) == budget.fraction(300, 1e4) == 1


def test_of_two_limits_the_first_reached_ends():
    budget = Budget(steps=200, minutes=2)
    assert budget.fraction(50, 12) == 0.25 and budget.fraction(50, 60) == 0.5
    assert budget.fraction(200, 12) == budget.fraction(50, 120) == 1
    assert budget.is_cut_short(199, 120) and not budget.is_cut_short(200, 120)
    assert not budget.is_cut_short(199, 119) and not Budget(minutes=2).is_cut_short(1, 120)


@pytest.mark.parametrize("cost", [0.5, 1.0, 4.0])
@pytest.mark.parametrize("windows", [0.2, 0.75])
def test_windows_take_their_share_of_the_work(windows, cost):
    """Counted update by update, each at its cost."""
    budget, steps = Budget(steps=3400), 3400
    fractions = [budget.fraction(step, 0.0, windows=windows, window_cost=cost) for step in range(steps + 1)]
    costs = [1.0 if fraction < 1 - windows - 1e-9 else cost for fraction in fractions[:-1]]
    done = [sum(costs[:step]) / sum(costs) for step in range(0, steps + 1, 100)]
    assert fractions[::100] == pytest.approx(done, abs=1e-3)
    assert fractions == sorted(fractions) and fractions[0] == 0 and fractions[-1] == 1


def test_all_of_the_work_may_be_windows():
    budget = Budget(steps=4)
    assert [budget.fraction(step, 0.0, windows=1.0, window_cost=4.0) for step in range(5)] == [0, 0.25, 0.5, 0.75, 1]


def test_a_limit_is_needed():
    with pytest.raises(ValueError, match="needs a limit: give steps, minutes or both"):
        Budget()


@pytest.mark.parametrize(
    "limits",
    [{"steps": 0}, {"steps": -1}, {"minutes": 0.0}, {"steps": 5, "minutes": -1.0}, {"steps": 1.5}, {"minutes": True}],
)
def test_limits_are_positive(limits):
    with pytest.raises(ValueError, match="must be (a whole number, 1 or more|positive and finite)"):
        Budget(**limits)
