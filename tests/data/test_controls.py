"""Random controls: within bounds, smooth, stationary, repeatable."""

from __future__ import annotations

import dataclasses
import multiprocessing

import numpy as np
import pytest
import torch

from torchrl_gn.data import spline_controls
from torchrl_gn.data.controls import numpy_generator
from torchrl_gn.scenes import Scene


def test_within_bounds_of_each_action(swimmer: Scene) -> None:
    low, high = np.array([-1.0, 0.0, 2.0, -9.0, -1e-3]), np.array([1.0, 4.0, 3.0, -8.0, 1e-3])
    scene = dataclasses.replace(swimmer, action_low=low, action_high=high)
    controls = spline_controls(scene, 200, 100, 0)
    assert controls.shape == (200, 100, 5) and controls.dtype == np.float64
    assert (controls >= low).all() and (controls <= high).all()
    np.testing.assert_allclose(controls.min((0, 1)), low, atol=1e-12)
    np.testing.assert_allclose(controls.max((0, 1)), high, atol=1e-12)
    np.testing.assert_allclose((controls.mean((0, 1)) - (low + high) / 2) / (high - low), np.zeros(5), atol=0.03)


def test_piecewise_cubic(swimmer: Scene) -> None:
    """Fourth differences of a cubic are zero: all but those across knots or clipping."""
    controls = spline_controls(swimmer, 50, 200, 0, knot_interval=40.0)
    fourth = np.abs(np.diff(controls, n=4, axis=1))
    assert (fourth < 1e-12).mean() > 0.75
    slow, fast = (np.abs(np.diff(spline_controls(swimmer, 50, 200, 0, knot_interval=k), axis=1)) for k in (40, 5))
    assert slow.max() < 0.15 and 4 < fast.mean() / slow.mean() < 12


def test_like_the_middle_at_the_ends_and_out_of_phase(swimmer: Scene) -> None:
    controls = spline_controls(swimmer, 3000, 31, 0)
    spread = controls.std(axis=(0, 2))
    assert np.ptp(spread) < 0.03 * spread.mean()
    # With knots every 10 steps and one phase for all, the spread would vary over steps.
    correlation = np.corrcoef(controls[:, 0, 0], controls[:, 30, 0])[0, 1]
    assert abs(correlation) < 0.15


def test_equal_seeds_equal_signals(swimmer: Scene) -> None:
    first = spline_controls(swimmer, 4, 20, 7)
    np.testing.assert_array_equal(first, spline_controls(swimmer, 4, 20, np.random.default_rng(7)))
    assert not np.array_equal(first, spline_controls(swimmer, 4, 20, 8))


def test_bad_arguments(swimmer: Scene) -> None:
    assert spline_controls(swimmer, 0, 5, 0).shape == (0, 5, 5)
    assert spline_controls(swimmer, 3, 1, 0).shape == (3, 1, 5)
    with pytest.raises(ValueError, match="knot_interval must be above 0 and finite, got 0"):
        spline_controls(swimmer, 1, 1, 0, knot_interval=0)
    with pytest.raises(ValueError, match="steps=-1"):
        spline_controls(swimmer, 1, -1, 0)


def _draw(pipe) -> None:
    pipe.send([int(numpy_generator(seed).integers(2**31)) for seed in (None, 7)])


def test_forked_processes_draw_seeds_of_their_own() -> None:
    """Forked processes inherit torch's generator, so their environments would begin the same episodes."""
    fork, drawn = multiprocessing.get_context("fork"), []
    for _ in range(2):
        ours, theirs = fork.Pipe()
        process = fork.Process(target=_draw, args=(theirs,))
        process.start()
        assert ours.poll(60)
        drawn.append(ours.recv())
        process.join()
    (first, seeded), (second, seeded_too) = drawn
    assert first != second and seeded == seeded_too == int(numpy_generator(7).integers(2**31))
    torch.manual_seed(3)
    first = numpy_generator(None).integers(2**31)
    torch.manual_seed(3)
    assert numpy_generator(None).integers(2**31) == first
