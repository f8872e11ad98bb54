"""Random controls, and NumPy generators from seeds."""

from __future__ import annotations

import math
import multiprocessing

import numpy as np
import torch

from torchrl_gn.checks import check_count, checked_seed
from torchrl_gn.scenes.articulation import Articulation
from torchrl_gn.scenes.control_bounds import require_bounds

_MARGIN = 2  # extra knots at each end, which keep the spline's end conditions out of the sequence


def spline_controls(
    scene: Articulation, num: int, steps: int, rng: int | np.random.Generator, *, knot_interval: float = 10.0
) -> np.ndarray:
    """Draw smooth action sequences ``[num, T, A]``, float64, in the actuators' units (paper, SM "Random control").

    Cubic splines pass through knots that are uniform within each action's bounds (for quaternions of mocap poses, near
    the model's), start at a random phase, and are clipped to the bounds.

    Args:
        rng: generator or seed.
        knot_interval: control steps between knots; the paper does not give it.

    Raises:
        SceneError: an action has no bounds.
    """
    check_count("num", num, 0)
    check_count("steps", steps, 0)
    check_knot_interval(knot_interval)
    rng = np.random.default_rng(rng)
    if num == 0 or steps == 0 or scene.num_actions == 0:
        return np.zeros((num, steps, scene.num_actions))
    require_bounds(scene)

    from scipy.interpolate import CubicSpline  # imported here, as that takes a second

    knots = math.ceil((steps - 1) / knot_interval) + 2 + 2 * _MARGIN
    values = rng.uniform(*scene.random_action_bounds, (knots, num, scene.num_actions))
    phase = rng.uniform(0.0, 1.0, (num, 1))  # one per sequence, so the spline object cannot evaluate them
    spline = CubicSpline(np.arange(knots), values, bc_type="natural")
    time = _MARGIN + phase + np.arange(steps) / knot_interval  # [num, T], in knots
    return np.clip(evaluate_cubics(spline.c, time[..., None]), scene.action_low, scene.action_high)


def evaluate_cubics(coefficients: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Evaluate splines ``[4, K - 1, n, A]`` at their own times in knots, ``[n, T, A]`` or ``[n, T, 1]``."""
    segment = np.clip(time.astype(np.int64), 0, coefficients.shape[1] - 1)
    x = time - segment
    row, column = np.arange(coefficients.shape[2])[:, None, None], np.arange(coefficients.shape[3])
    cubic = coefficients[:, segment, row, column]  # [4, n, T, A]
    return ((cubic[0] * x + cubic[1]) * x + cubic[2]) * x + cubic[3]


def check_knot_interval(knot_interval: float) -> None:
    """Raise ValueError if the interval is not above 0 and finite."""
    if not 0 < knot_interval < math.inf:
        raise ValueError(f"knot_interval must be above 0 and finite, got {knot_interval}")


def numpy_generator(seed: int | None) -> np.random.Generator:
    """Make a NumPy generator from a seed; None draws the seed from torch's global generator.

    Forked processes start with equal global generators: the seed then also depends on the process.
    """
    if seed is not None:
        return np.random.default_rng(checked_seed(seed))
    return np.random.default_rng([int(torch.randint(2**31, ()).item()), *worker()])


def known_seed(seed: int | None) -> int:
    """Return a seed; None draws it as :func:`numpy_generator` does. ValueError unless it is a whole number."""
    return int(numpy_generator(None).integers(2**31)) if seed is None else checked_seed(seed)


def worker() -> tuple[int, ...]:
    """Return the numbers of this process among its parents' children; ``()`` in the main process."""
    return getattr(multiprocessing.current_process(), "_identity", ())
