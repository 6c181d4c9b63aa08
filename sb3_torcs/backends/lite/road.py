"""Find a point's position on a road, its width and ground. Compiled, for the fallback world."""

from __future__ import annotations

import math

from numba import njit

from sb3_torcs import maths
from sb3_torcs.car import FloatArray as Floats
from sb3_torcs.tracks import track as column

atan2, cos_sin = maths.compiled(maths.atan2), maths.compiled(maths.cos_sin)


@njit(cache=True, inline="always")
def wrap(angle: float) -> float:
    """Bring an angle into [-pi, pi]."""
    while angle > math.pi:
        angle -= 2.0 * math.pi
    while angle < -math.pi:
        angle += 2.0 * math.pi
    return angle


@njit(cache=True, inline="always")
def _between(track: Floats, segment: int, first: int, along: float) -> float:
    """Interpolate a width given by the columns ``first`` (start) and ``first + 1`` (end)."""
    share = along / track[segment, column.LENGTH]
    return track[segment, first] + (track[segment, first + 1] - track[segment, first]) * share


@njit(cache=True)
def road_width(track: Floats, segment: int, along: float) -> float:
    """Width of the road [m] at a place of a segment."""
    return _between(track, segment, column.WIDTH_START, along)


@njit(cache=True)
def walls(track: Floats, segment: int, along: float) -> tuple[float, float]:
    """Distance [m] from the axis to the wall on the left and on the right."""
    half = 0.5 * road_width(track, segment, along)
    left = half + _between(track, segment, column.LEFT_START, along)
    return left, half + _between(track, segment, column.RIGHT_START, along)


@njit(cache=True)
def ground(track: Floats, segment: int, along: float, lateral: float) -> tuple[float, float]:
    """Friction and rolling resistance [-] at a place beside the axis, left positive [m]."""
    half = 0.5 * road_width(track, segment, along)
    if lateral > half:
        first = column.LEFT_FRICTION
    elif lateral < -half:
        first = column.RIGHT_FRICTION
    else:
        first = column.ROAD_FRICTION
    return track[segment, first], track[segment, first + 1]


@njit(cache=True)
def project(track: Floats, segment: int, x: float, y: float) -> tuple[int, float, float, float]:
    """
    Find a point's position on the road, starting from a segment near it.

    :param track: ``Track.table``
    :param segment: where to begin to look
    :param x: [m]
    :param y: [m]
    :return: the segment, how far along it [m], how far left of the axis [m], and the axis'
        direction there [rad], not wrapped
    """
    n = track.shape[0]
    along = offset = 0.0
    for _ in range(n):
        dx, dy = x - track[segment, column.X], y - track[segment, column.Y]
        heading, curvature = track[segment, column.HEADING], track[segment, column.CURVATURE]
        cosine, sine = cos_sin(heading)
        ahead = dx * cosine + dy * sine
        left = dy * cosine - dx * sine
        if curvature == 0.0:
            along, offset = ahead, left
        else:
            side = 1.0 if curvature > 0.0 else -1.0
            radius = 1.0 / abs(curvature)
            inward = radius - side * left  # from the centre of the arc towards the start
            # Measured from the middle of the arc, so that one of more than half a turn works too.
            half = 0.5 * abs(curvature) * track[segment, column.LENGTH]
            along = (wrap(atan2(ahead, inward) - half) + half) * radius
            offset = side * (radius - math.sqrt(ahead * ahead + inward * inward))
        if along < 0.0:
            segment = (segment - 1) % n
        elif along >= track[segment, column.LENGTH]:
            segment = (segment + 1) % n
        else:
            break
        # By rounding, a point between two segments may be in neither: take the border.
        along = min(max(along, 0.0), track[segment, column.LENGTH])
    tangent = track[segment, column.HEADING] + track[segment, column.CURVATURE] * along
    return segment, along, offset, tangent
