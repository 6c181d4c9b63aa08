"""The road as a profile along its length, from which a car's view ahead is read.

A world makes the profile of its road once. Looking ahead then costs two numbers of a table per
distance, wherever the car is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from sb3_torcs.car import FloatArray

__all__ = [
    "DISTANCES",
    "FASTEST",
    "INTERVALS",
    "QUANTITIES",
    "RoadProfile",
    "game_profile",
    "look_ahead",
    "place_at",
    "road_profile",
    "speed_margins",
]

DISTANCES = (0, 15, 30, 45, 60, 80, 100, 125, 155, 190, 230, 280, 340, 400)
"""[m] ahead of the car, at which the intervals of a preview meet: short ones near the car, but so
long that a fast car needs some timesteps for each, and its numbers do not jump."""
INTERVALS = len(DISTANCES) - 1
QUANTITIES = 3  # curvature, width, slope

STEP = 1.0  # [m] between the places of a profile, about
_AHEAD = np.array(DISTANCES, np.float64)

LATERAL, BRAKING = 15.0, 10.0  # [m/s²] in a bend and before it; what a careful driver dares
FASTEST = 100.0  # [m/s] on a straight
WINDOW = 5.0  # [m] between places where bends are measured, each over twice this length


@dataclass(frozen=True, eq=False)
class RoadProfile:
    """A road at places at equal distances, the first and the last on the start line."""

    sums: FloatArray  # (n + 1, 3) its turn [rad], area [m²] and climb [m] since the start line
    step: float  # [m] from one place to the next
    frictions: FloatArray  # (n + 1,) of its surface [-]
    bankings: FloatArray  # (n + 1,) by how much it rises to the left [m/m]


def road_profile(
    lengths: FloatArray,
    curvatures: FloatArray,
    widths: FloatArray,
    climbs: FloatArray,
    frictions: FloatArray,
    bankings: FloatArray,
) -> RoadProfile:
    """
    Make the profile of a closed road.

    :param lengths: (n,) of its segments [m], from the start line on
    :param curvatures: (n,) of the axis [1/m], left positive
    :param widths: (n,) in the mean [m]
    :param climbs: (n,) by how much their ends lie higher than their beginnings [m]
    :param frictions: (n,) of their surface [-]
    :param bankings: (n,) by how much they rise to the left in the mean [m/m]
    :return: the profile
    """
    ends = np.concatenate(([0.0], np.cumsum(lengths)))
    number = max(round(ends[-1] / STEP), 1)
    places = np.linspace(0.0, ends[-1], number + 1)
    added = (curvatures * lengths, widths * lengths, climbs)
    sums = [np.interp(places, ends, np.concatenate(([0.0], np.cumsum(row)))) for row in added]
    segment = np.minimum(np.searchsorted(ends[1:], places, side="right"), len(lengths) - 1)
    columns = np.stack(sums, axis=1), frictions[segment], bankings[segment]
    for column in columns:
        column.setflags(write=False)
    table, friction, banking = columns
    return RoadProfile(table, float(ends[-1]) / number, friction, banking)


def game_profile(road: FloatArray) -> RoadProfile:
    """
    Make the profile of a road as the game has laid it, with its hills.

    :param road: (n_segments, 17) from the engine
    """
    length, curvature, start_width, end_width, _, _, _, _, friction, *_ = road.T
    height, end_height, rise, end_rise = road.T[-4:]
    width = 0.5 * (start_width + end_width)
    banking = 0.5 * (rise + end_rise) / width
    return road_profile(length, curvature, width, end_height - height, friction, banking)


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
