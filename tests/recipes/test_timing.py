"""Run times are taken in turn."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace

import torch

import _version_times
from _common.sweeps import mean_and_half_range
from _timing import time_in_turn


def test_each_runs_once_a_round_and_warm_up_is_not_timed():
    order = []
    works = {name: lambda name=name: order.append(name) for name in ("a", "b")}
    seconds = time_in_turn(works, repeats=2, warm_up=3)
    assert order == ["a", "b"] * 5
    assert {name: len(values) for name, values in seconds.items()} == {"a": 2, "b": 2}
    assert min(seconds["a"] + seconds["b"]) >= 0


def test_half_range_is_half_of_largest_less_smallest():
    assert mean_and_half_range([1.0, 2.0, 6.0]) == (3.0, 2.5) and mean_and_half_range([4.0]) == (4.0, 0.0)


def test_simulations_are_timed_for_no_more_steps_than_they_have(call, tmp_path):
    code, output, errors = call("steps=1001", f"run_dir={tmp_path / 'run'}", recipe="benchmarks/simulation")
    assert code == 1 and "steps=1001" in output + errors and "1000 control steps" in output + errors


def test_times_of_versions_are_those_of_all_threads(monkeypatch):
    """A call that another thread works for takes that thread's time."""

    def busy() -> None:
        start = time.thread_time()
        while time.thread_time() - start < 0.02:
            pass

    def run() -> None:
        other = threading.Thread(target=busy)
        other.start()
        other.join()

    monkeypatch.setattr(_version_times, "works", lambda cfg: [("work", run)])
    cfg = SimpleNamespace(threads=torch.get_num_threads(), seed=0, seconds=0.05)
    assert _version_times.measure(cfg)["work"] >= 19
