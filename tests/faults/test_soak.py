"""A short soak: its tasks run, and leaks are told from temporary use."""

from __future__ import annotations

import pytest

from .soak import WORK, Level, growth


@pytest.mark.slow
@pytest.mark.parametrize("work", WORK, ids=lambda work: work.__name__)
def test_its_work_runs(work, tmp_path):
    for index in range(2):
        work(index, tmp_path)


@pytest.mark.parametrize(("leak", "grown"), [(0.0, 1.0), (1.0, 1.5)])
def test_growth_is_that_of_what_stays(leak, grown):
    levels = [Level(60 * each, each, 110 + leak * each + 20 * (each % 3 > 0), 2, 10) for each in range(61)]
    found = growth(levels)
    assert found["memory"] == pytest.approx(grown, rel=0.05)
    assert found["threads"] == found["files"] == 1
