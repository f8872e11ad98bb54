"""Run times of several pieces of work, each in turn."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

from tqdm import tqdm


def time_in_turn(
    works: Mapping[str, Callable[[], object]], repeats: int, *, warm_up: int = 1, desc: str = "measuring"
) -> dict[str, list[float]]:
    """Time each piece of work once a round, so that slow phases of the machine hit all; return the seconds by name.

    Args:
        works: what to time, by name.
        repeats: rounds that are timed.
        warm_up: untimed rounds before them.
        desc: text of the progress bar.
    """
    seconds: dict[str, list[float]] = {name: [] for name in works}
    for turn in tqdm(range(warm_up + repeats), desc=desc, leave=False):
        for name, run in works.items():
            start = time.perf_counter()
            run()
            if turn >= warm_up:
                seconds[name].append(time.perf_counter() - start)
    return seconds
