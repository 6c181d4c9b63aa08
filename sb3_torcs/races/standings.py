"""What many races say about their drivers."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean
from typing import Any

import numpy as np

from sb3_torcs.races.protocol import Race, Standing
from sb3_torcs.races.ratings import ratings

__all__ = ["driver_figures", "mean_interval", "wilson"]

RESAMPLES = 2000


def wilson(wins: int, races: int) -> list[float]:
    """
    Estimate a win rate, with the 95 % interval of Wilson 1927 (doi 10.2307/2276774).

    :param wins: of the races
    :param races: at least 1
    :return: low, rate, high
    """
    from scipy.stats import binomtest

    interval = binomtest(wins, races).proportion_ci(0.95, method="wilson")
    return [float(interval.low), wins / races, float(interval.high)]


def mean_interval(places: Sequence[int]) -> list[float] | None:
    """
    Estimate the 95 % interval of a mean place, by the percentile bootstrap.

    The bootstrap is seeded, so that the same races give the same interval.

    :param places: of a driver, one per race
    :return: low, high; ``None`` if all places are the same, which tells nothing of their spread
    """
    from scipy.stats import bootstrap

    if len(set(places)) < 2:
        return None
    interval = bootstrap(
        (places,), np.mean, n_resamples=RESAMPLES, method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval  # fmt: skip
    return [float(interval.low), float(interval.high)]


def driver_figures(races: Sequence[Race]) -> list[dict[str, Any]]:
    """
    Sum the races of each driver up.

    :param races: in the order in which they were held
    :return: one dict per driver, the best rating first
    """
    rated = ratings([[standing.driver for standing in race.standings] for race in races])
    figures = [
        _figures(driver, [s for race in races for s in race.standings if s.driver == driver])
        for driver in rated
    ]
    for figure in figures:
        figure["rating"] = rated[figure["driver"]]
    return sorted(figures, key=lambda figure: -figure["rating"][0])


def _figures(driver: str, standings: Sequence[Standing]) -> dict[str, Any]:
    wins = sum(standing.place == 1 and not standing.out for standing in standings)
    places = [standing.place for standing in standings]
    return {
        "driver": driver,
        "races": len(standings),
        "wins": wins,
        "win_rate": wilson(wins, len(standings)),
        "mean_place": fmean(places),
        "mean_place_interval": mean_interval(places),
        "finished": sum(not standing.out for standing in standings),
        "damage_per_km": _damage_per_km(standings),
    }


def _damage_per_km(standings: Sequence[Standing]) -> float:
    damage = sum(standing.damage for standing in standings)
    distance = sum(standing.distance for standing in standings)
    return 1000.0 * damage / distance if distance > 0.0 else 0.0
