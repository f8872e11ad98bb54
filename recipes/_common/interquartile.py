"""The interquartile mean of returns and its bootstrap interval, as rliable computes them (Agarwal et al. 2021)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import trim_mean

_CUT = 0.25  # share of the scores that is left out at each end, rounded down to whole scores


def interquartile_mean(scores: ArrayLike) -> float:
    """Return the mean of the middle half of all scores, of any shape; three scores or fewer all count."""
    return float(trim_mean(np.ravel(scores), _CUT))


def interquartile_interval(
    scores: ArrayLike, *, level: float = 0.95, samples: int = 2000, seed: int = 0
) -> tuple[float, float]:
    """Return the bootstrap interval of the interquartile mean, stratified by task.

    Each sample draws every task's runs with replacement, independently of other tasks. The interval lies between
    percentiles of the samples' interquartile means.

    Args:
        scores: ``[runs, tasks]``.
        level: share of the samples' means within the interval.
        samples: number of bootstrap samples.
        seed: seed of the draws; calls with scores of the same shape and the same seed share their draws.
    """
    scores = np.asarray(scores)
    drawn = np.random.default_rng(seed).integers(len(scores), size=(samples, *scores.shape))
    means = trim_mean(np.take_along_axis(scores[None], drawn, axis=1).reshape(samples, -1), _CUT, axis=1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)
