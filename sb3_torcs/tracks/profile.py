"""The road as a profile along its length, from which a car's view ahead is read.

A world makes the profile of its road once. Looking ahead then costs two numbers of a table per
distance, wherever the car is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sb3_torcs.car import FloatArray

__all__ = ["RoadProfile", "game_profile", "road_profile"]

STEP = 1.0  # [m] between the places of a profile, about


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
