"""What a car sees of a road ahead, read from the road's profile by compiled functions.

They stand apart from :mod:`sb3_torcs.tracks.profile`, so that to list tracks takes no compiler.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sb3_torcs.car import FloatArray

__all__ = [
    "DISTANCES",
    "FASTEST",
    "INTERVALS",
    "QUANTITIES",
    "look_ahead",
    "place_at",
    "speed_margins",
]

DISTANCES = (0, 15, 30, 45, 60, 80, 100, 125, 155, 190, 230, 280, 340, 400)
"""[m] ahead of the car, at which the intervals of a preview meet: short ones near the car, but so
long that a fast car needs some timesteps for each, and its numbers do not jump."""
INTERVALS = len(DISTANCES) - 1
QUANTITIES = 3  # curvature, width, slope
_AHEAD = np.array(DISTANCES, np.float64)

LATERAL, BRAKING = 15.0, 10.0  # [m/s²] in a bend and before it; what a careful driver dares
FASTEST = 100.0  # [m/s] on a straight
WINDOW = 5.0  # [m] between places where bends are measured, each over twice this length


@njit(cache=True)
def place_at(table: FloatArray, step: float, distance: float) -> tuple[int, int, float]:
    """
    Find a place by its distance from the start line.

    :param table: (n + 1, k) rows at equal distances, the first and the last on the start line
    :param step: from one row to the next [m]
    :param distance: beyond a lap, too [m]
    :return: whole laps, the row before the place, and its share of the step to the next one
    """
    places = len(table) - 1
    where = distance / step
    laps = math.floor(where / places)
    where -= laps * places
    index = min(int(where), places - 1)
    return laps, index, where - index


@njit(cache=True)
def _sum_at(sums: FloatArray, place: tuple[int, int, float], quantity: int) -> float:
    """What a quantity has added up to since the start line, whole laps included."""
    laps, index, share = place
    here, there = sums[index, quantity], sums[index + 1, quantity]
    return float(laps * sums[len(sums) - 1, quantity] + here + share * (there - here))


@njit(cache=True)
def look_ahead(sums: FloatArray, step: float, distance: float, means: FloatArray) -> None:
    """
    Take the means of curvature, width and slope over the intervals ahead of a car.

    :param sums: of a :class:`RoadProfile`
    :param step: of it [m]
    :param distance: of the car from the start line [m]
    :param means: (3, intervals) filled: curvature [1/m], width [m] and slope [m/m]
    """
    for i in range(len(_AHEAD)):
        place = place_at(sums, step, distance + _AHEAD[i])
        for quantity in range(QUANTITIES):
            total = _sum_at(sums, place, quantity)
            if i > 0:
                means[quantity, i - 1] += total
                means[quantity, i - 1] /= _AHEAD[i] - _AHEAD[i - 1]
            if i < len(_AHEAD) - 1:
                means[quantity, i] = -total


@njit(cache=True)
def _turned(sums: FloatArray, step: float, distance: float) -> float:
    """How much a road has turned since the start line [rad]; ``distance`` may be beyond a lap."""
    return _sum_at(sums, place_at(sums, step, distance), 0)


@njit(cache=True)
def speed_margins(
    sums: FloatArray, step: float, distance: float, speed: float, margins: FloatArray
) -> None:
    """
    Find by how much a car may be faster now, in the light of each interval ahead.

    A bend of radius R is driven at √(15 m/s² · R), and 10 m/s² slow down on the way to it. Of each
    interval the place that asks for the lowest speed counts.

    :param sums: of a :class:`RoadProfile`
    :param step: of it [m]
    :param distance: of the car from the start line [m]
    :param speed: of the car [m/s]
    :param margins: (intervals,) filled [m/s]
    """
    ahead = 0.0
    before = _turned(sums, step, distance - WINDOW)
    here = _turned(sums, step, distance)
    for i in range(len(margins)):
        least = FASTEST
        while ahead < _AHEAD[i + 1]:
            after = _turned(sums, step, distance + ahead + WINDOW)
            curvature = abs(after - before) / (2.0 * WINDOW)
            in_bend = min(LATERAL / max(curvature, 1e-9), FASTEST**2)
            least = min(least, math.sqrt(in_bend + 2.0 * BRAKING * ahead))
            before, here = here, after
            ahead += WINDOW
        margins[i] = least - speed
