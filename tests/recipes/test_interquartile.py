"""The interquartile mean and its bootstrap interval against values computed by hand."""

from __future__ import annotations

import pytest

from _common.interquartile import interquartile_interval, interquartile_mean


@pytest.mark.parametrize(
    ("scores", "expected"),
    [
        ([7], 7),
        ([0, 3, 9], 4),  # a quarter of three is no whole score
        ([0, 10, 20, 30, 1000], 20),
        ([8, 1, 6, 3, 5, 4, 7, 2], 4.5),
        ([[1, 2, 3, 4], [5, 6, 7, 800]], 4.5),  # of all runs and tasks at once
    ],
)
def test_interquartile_mean(scores, expected):
    assert interquartile_mean(scores) == expected


@pytest.mark.parametrize(
    ("level", "expected"),
    [(0.95, (0, 1)), (0.6, (0, 1)), (0.4, (0.5, 0.5))],
)
def test_interval_of_two_runs(level, expected):
    """Of two runs a quarter of all samples has the mean 0, half 0.5 and a quarter 1."""
    assert interquartile_interval([[0], [1]], level=level) == expected


def test_interval_of_three_runs():
    """Of 27 samples one is of the least alone, 1 / 27 > 0.025; the three of mean 1 end at 4 / 27."""
    runs = [[0], [3], [6]]
    assert interquartile_interval(runs) == (0, 6)
    assert interquartile_interval(runs, level=0.8, samples=20_000) == (1, 5)


def test_samples_are_drawn_within_tasks():
    assert interquartile_interval([[0, 10], [0, 10], [0, 10]]) == (5, 5)
    # Of four scores the middle two: the one of 0 and 1 that is higher, and 10.
    assert interquartile_interval([[0, 10], [1, 10]]) == (5, 5.5)


def test_intervals_share_their_draws():
    assert interquartile_interval([[1], [2], [4]], seed=3) == interquartile_interval([[1], [2], [4]], seed=3)
    low, high = interquartile_interval([[1], [2], [4]])
    assert interquartile_interval([[11], [12], [14]]) == pytest.approx((low + 10, high + 10))
