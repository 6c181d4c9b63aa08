"""Figures over seeds: interquartile means, shares, and their 95 % bootstrap intervals.

As Agarwal et al. 2021 (arXiv:2108.13264), by SciPy; the bootstrap is seeded, so the same results
give the same figures.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

__all__ = ["Array", "Estimate", "estimate", "iqm", "share"]

Array = npt.NDArray[np.float64]

REPETITIONS = 2000  # of the bootstrap
LEVEL = 0.95
CUT = 0.25  # of the seeds, at either end


class Estimate(NamedTuple):
    """A figure over seeds, and the interval that it lies in."""

    value: Array  # (points,)
    low: Array  # (points,)
    high: Array  # (points,)


class Statistic(Protocol):
    """A figure over one axis of an array."""

    def __call__(self, scores: Array, /, axis: int) -> Array:
        """
        :param scores: any shape
        :param axis: of the seeds
        :return: the same shape without this axis
        """


def iqm(scores: Array, axis: int = 0) -> Array:
    """
    Average the middle half of the seeds.

    :param scores: any shape
    :param axis: of the seeds
    :return: the same shape without this axis
    """
    from scipy.stats import trim_mean

    return np.asarray(trim_mean(scores, CUT, axis=axis))


def share(scores: Array, axis: int = 0) -> Array:
    """
    Average all seeds: the share of ones.

    :param scores: any shape
    :param axis: of the seeds
    :return: the same shape without this axis
    """
    return np.asarray(scores.mean(axis=axis))


def estimate(scores: Array, function: Statistic = iqm) -> Estimate:
    """
    Estimate a figure over seeds. The bootstrap draws whole seeds, with all their points.

    :param scores: (seeds, points)
    :param function: of the seeds
    :return: value and interval
    """
    from scipy.stats import bootstrap

    value = function(scores, axis=0)
    if len(scores) < 2:  # which SciPy refuses, and which has no spread
        return Estimate(value, value, value)
    # SciPy's own interval, which is not used, interpolates between laps that were never driven.
    with np.errstate(invalid="ignore"):
        drawn = bootstrap(
            (scores,), function, n_resamples=REPETITIONS, axis=0, vectorized=True,
            method="percentile", rng=np.random.default_rng(0),
        ).bootstrap_distribution  # fmt: skip
    tail = 0.5 * (1.0 - LEVEL)
    # Without interpolation, which is undefined for laps that were never driven (infinity).
    low, high = np.quantile(drawn, [tail, 1.0 - tail], axis=-1, method="inverted_cdf")
    return Estimate(value, low, high)
