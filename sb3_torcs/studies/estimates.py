"""Figures over seeds: interquartile means with 95 % stratified bootstrap intervals.

As Agarwal et al. 2021 (arXiv:2108.13264), by rliable; the bootstrap is seeded, so the same results
give the same figures.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

__all__ = ["Array", "Estimate", "estimate", "iqm", "share"]

Array = npt.NDArray[np.float64]

REPETITIONS = 2000  # of the bootstrap
LEVEL = 0.95


class Estimate(NamedTuple):
    """A figure over seeds, and the interval that it lies in."""

    value: Array  # (points,)
    low: Array  # (points,)
    high: Array  # (points,)


def iqm(scores: Array) -> Array:
    """
    Average the middle half of the seeds: rliable's ``aggregate_iqm`` for all points at once.

    It is called thousands of times, and SciPy's ``trim_mean`` would take a millisecond each.

    :param scores: (seeds, 1, points)
    :return: (points,)
    """
    cut = len(scores) // 4
    middle = np.sort(scores[:, 0], axis=0)[cut : len(scores) - cut]
    return np.asarray(middle.mean(axis=0))


def share(scores: Array) -> Array:
    """
    Average all seeds: the share of ones.

    :param scores: (seeds, 1, points)
    :return: (points,)
    """
    return np.asarray(scores.mean(axis=0)[0])


def estimate(scores: Array, function: Callable[[Array], Array] = iqm) -> Estimate:
    """
    Estimate a figure over seeds, with a stratified bootstrap.

    :param scores: (seeds, points)
    :param function: of (seeds, 1, points)
    :return: value and interval
    """
    from rliable.library import StratifiedBootstrap

    class Seeded(StratifiedBootstrap):
        """Uses a generator of its own; rliable's uses the global one."""

        def update_indices(self) -> tuple[Any, ...]:
            drawn = self.generator.choice(self._num_items, self._args_shape, replace=True)
            return (drawn, *self._strata_indices)

    stacked = scores[:, None, :]
    drawn = Seeded(stacked, seed=0).apply(function, reps=REPETITIONS)
    tail = 0.5 * (1.0 - LEVEL)
    # Without interpolation, which is undefined for laps that were never driven (infinity).
    low, high = np.quantile(drawn, [tail, 1.0 - tail], axis=0, method="inverted_cdf")
    return Estimate(function(stacked), low, high)
