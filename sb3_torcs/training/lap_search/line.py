"""Lines: drives that a search follows and improves, and what a place on them is worth.

A line is an array of waypoints, as ``native/rollouts.h`` defines them: where the car was at the
beginning of each timestep, and the controls that it was then given.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sb3_torcs import maths
from sb3_torcs.car import CarState, Controls, FloatArray

__all__ = ["PEDAL", "STEERING", "Line", "blended", "lap_of", "repeated", "waypoint"]

_exp = maths.compiled(maths.exp)

TIME, DISTANCE, OFFSET, HEADING, SPEED, STEERING, PEDAL = range(7)

THROTTLE = 0.9  # [-] from which a line counts as accelerating
FADING = 4.0  # [s] in which a car on full throttle loses most of a difference of speed
LEAST_FADING = 0.2  # [s] elsewhere
WALKING = 2.0  # [m/s] as in native/rollouts.cpp
LAUNCH = 20.0  # [m] within which a slow car sets off; elsewhere it has spun
SLOWEST = 10.0  # [m/s] for the worth of speed
DRIFT_COST = 0.01  # [s/m²] of being beside the line
TURN_COST = 0.5  # [s/rad²] of heading elsewhere than the line
BLEND = 60.0  # [m] in which one line becomes another
SIMILAR_SPEED = 0.97  # of another line's, from which a car that sets off can follow that


def waypoint(car: CarState, controls: Controls) -> list[float]:
    """
    Make a waypoint of a drive.

    :param car: at the beginning of a timestep
    :param controls: of that timestep
    """
    pedal = controls.throttle - controls.brake
    place = (car.time, car.distance_raced, car.distance_from_axis, car.heading_error, car.speed_x)
    return [*place, controls.steering, pedal]


class Line:
    """
    A line, and the worth of being somewhere near it.

    :param rows: (n, 7) waypoints
    """

    def __init__(self, rows: FloatArray) -> None:
        self.rows = rows
        self._distance = np.maximum.accumulate(rows[:, DISTANCE])
        self._speed_worth = _speed_worth(rows)

    def rows_from(self, car: FloatArray, driven: int) -> FloatArray:
        """
        Return the rest of the line.

        :param car: (7,) waypoint from which to go on
        :param driven: timesteps since the line's begin, for a car that sets off
        """
        last = len(self.rows) - 2
        if car[SPEED] < WALKING and car[DISTANCE] < LAUNCH and driven < last:
            return self.rows[driven:]
        first = int(np.searchsorted(self._distance, car[DISTANCE], "right")) - 1
        return self.rows[min(max(first, 0), last) :]

    def gain(self, begin: FloatArray, ends: FloatArray) -> FloatArray:
        """
        Compute what drives have won against the line.

        Speed counts for as long as the line accelerates; to be elsewhere than the line costs,
        because the way back to it takes time.

        :param begin: (7,) where they began
        :param ends: (n, 7) where they ended
        :return: (n,) [s]
        """
        where = ends[:, DISTANCE]
        took = ends[:, TIME] - begin[TIME]
        there = float(np.interp(begin[DISTANCE], self._distance, self.rows[:, TIME]))
        gain: FloatArray = self._at(where, self.rows[:, TIME]) - there - took
        faster = ends[:, SPEED] - self._at(where, self.rows[:, SPEED])
        gain += self._at(where, self._speed_worth) * faster
        gain -= DRIFT_COST * (ends[:, OFFSET] - self._at(where, self.rows[:, OFFSET])) ** 2
        gain -= TURN_COST * (ends[:, HEADING] - self._at(where, self.rows[:, HEADING])) ** 2
        return gain

    def _at(self, distance: FloatArray, values: FloatArray) -> FloatArray:
        found: FloatArray = np.interp(distance, self._distance, values)
        return found


def _speed_worth(rows: FloatArray) -> FloatArray:
    """Seconds that 1 m/s more are worth at each waypoint."""
    accelerates = rows[:, PEDAL] > THROTTLE
    left = np.zeros(len(rows))  # [s] until the line does not accelerate any more
    for index in range(len(rows) - 2, -1, -1):
        if accelerates[index]:
            left[index] = left[index + 1] + rows[index + 1, TIME] - rows[index, TIME]
    lasts = (
        FADING * (1.0 - np.array([_exp(-seconds / FADING) for seconds in left.tolist()]))
        + LEAST_FADING
    )
    worth: FloatArray = lasts / np.maximum(rows[:, SPEED], SLOWEST)
    return worth


def lap_of(rows: FloatArray, begin: float, length: float) -> FloatArray:
    """
    Cut a lap out of a drive, with one waypoint more before it and after it.

    :param rows: (n, 7)
    :param begin: distance raced at its begin [m]
    :param length: of the track [m]
    :return: (m, 7), with a distance of 0 at the beginning
    """
    distance = np.maximum.accumulate(rows[:, DISTANCE])
    first, last = np.searchsorted(distance, [begin, begin + length])
    lap = rows[max(first - 1, 0) : last + 1].copy()
    lap[:, DISTANCE] -= begin
    return lap


def repeated(lap: FloatArray, length: float, times: Sequence[int]) -> FloatArray:
    """
    Put a lap behind itself.

    :param lap: (m, 7) of :func:`lap_of`
    :param length: of the track [m]
    :param times: which laps are wanted, ascending; 0 is the first one after the start line
    :return: one line; its distances are from the first crossing of the start line
    """
    seconds = np.interp([0.0, length], lap[:, DISTANCE], lap[:, TIME])
    inside = lap[(lap[:, DISTANCE] >= 0.0) & (lap[:, DISTANCE] < length)]
    parts = []
    for number in times:
        part = inside.copy()
        part[:, DISTANCE] += number * length
        part[:, TIME] += number * (seconds[1] - seconds[0])
        parts.append(part)
    return np.concatenate(parts)


def blended(launch: FloatArray, flying: FloatArray) -> FloatArray:
    """
    Set off as one line does, and go on as another one, which is faster.

    :param launch: (n, 7) from the grid
    :param flying: (m, 7) at the same distances, and beyond
    :return: one line; the first one, if its speed never comes near the other's
    """
    distance = np.maximum.accumulate(launch[:, DISTANCE])
    columns = [np.interp(distance, flying[:, DISTANCE], flying[:, i]) for i in range(7)]
    other = np.stack(columns, axis=1)
    inside = distance >= flying[0, DISTANCE] + BLEND
    similar = inside & (launch[:, SPEED] >= SIMILAR_SPEED * other[:, SPEED])
    if not similar.any():
        return launch
    first = int(np.argmax(similar))
    share = np.clip((distance - distance[first]) / BLEND, 0.0, 1.0)[:, None]
    mixed = launch + share * (other - launch)
    # A line's time goes on without a jump, whatever either drive took before.
    mixed[:, [TIME, DISTANCE]] = launch[:, [TIME, DISTANCE]]
    last = int(np.searchsorted(distance, distance[first] + BLEND))
    if last >= len(distance):
        return launch
    end = int(np.searchsorted(flying[:, DISTANCE], distance[last], "right"))
    rest = flying[end:].copy()
    if not len(rest):
        return launch
    reached = np.interp(distance[last], flying[:, DISTANCE], flying[:, TIME])
    rest[:, TIME] += mixed[last, TIME] - reached
    return np.concatenate([mixed[: last + 1], rest])
