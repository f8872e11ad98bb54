"""Recipes that are struck anywhere and resumed end with the numbers of uninterrupted runs.

Few strikes, at file operations that fixed seeds choose; many of all kinds: ``python -m tests.faults``.
"""

from __future__ import annotations

import random
from collections.abc import Iterator

import pytest

from .bench import FULL, SIGNALS, Bench, can_mount, draw_strike
from .server import serving

pytestmark = pytest.mark.slow  # programs from start to end


@pytest.fixture(scope="module")
def bench(tmp_path_factory) -> Iterator[Bench]:
    pytest.importorskip("hydra")
    with serving() as server:
        yield Bench(server, tmp_path_factory.mktemp("runs"))


@pytest.mark.parametrize("name", ["forward_model", "shac", "mpc", "value", "svg", "compare"])
def test_a_struck_run_ends_in_the_same_numbers(name, bench):
    """Two of: killed, interrupted, told to end, out of disk; of two processes at once, the second is refused."""
    draw, whole = random.Random(name), bench.whole(name)
    kinds = draw.sample([*SIGNALS, FULL], 2)
    strikes = [draw_strike(draw, whole, kind, early=0.3, timed=0) for kind in kinds]
    assert bench.strike(name, strikes) == []


def test_a_run_on_a_full_disk_goes_on_once_there_is_room(bench, tmp_path):
    if not can_mount(tmp_path):
        pytest.skip("needs leave to mount a disk in memory")
    assert bench.fill("mpc", 0.6) == []


@pytest.mark.parametrize(
    ("name", "file", "how", "outcome"),
    [
        ("mpc", "gn.safetensors", "flipped in the middle", "refused"),
        ("mpc", "config.yaml", "cut in the middle", "refused"),
        ("value", "checkpoint/checkpoint.safetensors", "zeroed in part", "read"),
        ("shac", "rounds/001/numbers.json", "flipped in the middle", "refused"),
        ("shac", "rounds/000/policy.safetensors", "cut at its end", "read"),
    ],
)
def test_a_damaged_run_is_refused_by_name_or_ends_in_the_same_numbers(name, file, how, outcome, bench):
    whole = bench.whole(name)
    found = next(each for each in whole.files if each.as_posix() == f"run/{file}")
    assert bench.damaged(name, found, how, random.Random(0)) == (outcome, [])
