"""Ratings of drivers over many races, by openskill."""

from __future__ import annotations

from collections.abc import Sequence

from sb3_torcs.errors import needs_extra

__all__ = ["ratings"]


def ratings(orders: Sequence[Sequence[str]]) -> dict[str, list[float]]:
    """
    Rate drivers by the Plackett-Luce model of Weng and Lin 2011 (JMLR 12:267-300).

    All begin with 25 ± 8.3. Who comes in before another of a higher rating gains more.

    :param orders: of each race the drivers, the winner first
    :return: the rating of each driver and its standard deviation
    """
    with needs_extra("a rating"):
        from openskill.models import PlackettLuce

    model = PlackettLuce()
    rated = {driver: model.rating() for order in orders for driver in order}
    for order in orders:
        if len(order) > 1:
            teams = model.rate([[rated[driver]] for driver in order])
            rated.update((driver, team[0]) for driver, team in zip(order, teams, strict=True))
    return {driver: [float(rating.mu), float(rating.sigma)] for driver, rating in rated.items()}
