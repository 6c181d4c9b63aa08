"""Turn the states of an SCR server into states of the car: position, laps and times."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sb3_torcs.car import CONTROL_TICK, NO_RACE, CarState, FloatArray
from sb3_torcs.errors import InvalidOption
from sb3_torcs.scr.protocol import ScrState, parse_state
from sb3_torcs.tracks.generator import plain_segment
from sb3_torcs.tracks.track import WIDTH_END, WIDTH_START, Track

__all__ = ["UNKNOWN_ROAD", "CarReader", "standing"]

MARGIN = 1.0  # [m] tolerance between two sums of a track's length
JUMP = 100.0  # [m] between two ways to measure the distance, from which on one has begun a lap
WIDTH = 12.0  # [m] of a road that is not known; the game's have 10 to 16
VERGE = 5.0  # [m] beside it

UNKNOWN_ROAD = Track("unknown", "road", (plain_segment(1e6, 0.0, WIDTH, VERGE),))
"""What stands in for a road that is not known: a straight that is longer than any lap. On it a car
has the place across the road that the server tells, and the angle to it."""


class _Place(NamedTuple):
    """Where a car is on the track."""

    x: float  # [m]
    y: float  # [m]
    yaw: float  # [rad]
    offset: float  # [m] from the axis, left positive
    width: float  # [m] of the road
    distance: float  # [m] from the start line


class CarReader:
    """
    Follows one car, state by state.

    :param track: on which it drives; :data:`UNKNOWN_ROAD` if that is not known
    """

    def __init__(self, track: Track) -> None:
        self._track = track
        self._jump = min(0.5 * track.length, JUMP)

    def begin(self, state: ScrState) -> CarState:
        """
        Take the first state of an episode.

        :param state: the server's
        :return: the car
        :raises InvalidOption: if the car is not on the track
        """
        self._before = state
        self._time = state.lap_time
        self._laps = 0
        self._best = 0.0
        self._tick = CONTROL_TICK
        self._raced = state.distance_raced
        # The distance since the start grows but has six digits. The distance on the lap is more
        # precise, so the first only gives the number of laps to add.
        self._lap_began = state.distance_raced - state.distance_from_start
        return self._car(state, self._place(state), state.yaw_rate or 0.0)

    def read(self, state: ScrState, ticks: int, earlier: bytes | None = None) -> CarState:
        """
        Take the state at the end of a step.

        :param state: the server's
        :param ticks: control ticks since the one before
        :param earlier: the server's message of a tick before, by which the yaw rate is computed if
            the server does not tell it
        :return: the car
        :raises InvalidOption: if the car is where the track is not
        """
        before, self._before = self._before, state
        duration = state.lap_time - before.lap_time
        if duration < 0.0:  # a lap has begun
            # The game's ticks take ten of its steps, or eleven: as those before.
            duration = self._tick * ticks
            if state.last_lap_time > 0.0:
                duration = state.last_lap_time - before.lap_time + state.lap_time
                self._laps += 1
                self._best = min(self._best or math.inf, state.last_lap_time)
        self._tick = duration / ticks
        self._time += duration
        raced = self._lap_began + state.distance_from_start
        if abs(state.distance_raced - raced) > self._jump:
            self._lap_began = state.distance_raced - state.distance_from_start
        place, yaw_rate = self._place(state), state.yaw_rate or 0.0
        if state.yaw_rate is None and earlier is not None:
            then = parse_state(earlier)
            turned = math.remainder(place.yaw - self._place(then).yaw, math.tau)
            lasted = state.lap_time - then.lap_time
            yaw_rate = turned / (lasted if lasted > 0.0 else self._tick or CONTROL_TICK)
        return self._car(state, place, yaw_rate)

    def _place(self, state: ScrState) -> _Place:
        """Find out where the server's car is on the track."""
        track = self._track
        distance = state.distance_from_start
        if distance >= track.length:
            if distance > track.length + MARGIN:
                raise InvalidOption(
                    f"the server's car is {distance:g} m behind the start line, but a lap of "
                    f"{track.name} has {track.length:.0f} m; give the server's track"
                )
            distance = 0.0
        segment, along = track.find(distance)
        begin, end = track.table[segment, WIDTH_START : WIDTH_END + 1].tolist()
        width = begin + (end - begin) * along / track.segments[segment].length
        offset = 0.5 * width * state.track_position
        x, y, heading = track.pose_on(segment, along, offset)
        yaw = math.remainder(heading - state.heading_error, math.tau)
        return _Place(x, y, yaw, offset, width, distance)

    def _car(self, state: ScrState, place: _Place, yaw_rate: float) -> CarState:
        """Put the car together."""
        values = (
            self._time, place.x, place.y, place.yaw, yaw_rate,
            state.speed_x, state.speed_y, state.speed_z, state.height, state.heading_error,
            place.offset, place.width, place.distance,
            self._lap_began + state.distance_from_start - self._raced,
            state.engine_speed, state.gear, state.fuel, state.damage,
            self._laps, state.lap_time, state.last_lap_time, self._best, state.race_position,
            _read_only(state.wheel_speeds), _read_only(state.range_finders),
            _read_only(state.opponents), _read_only(NO_RACE),
        )  # fmt: skip
        return CarState._make(values)


def standing(state: CarState, ticks: int) -> CarState:
    """
    Let a car stand that has been taken out of the race.

    :param state: the last one that was told
    :param ticks: that pass
    """
    return state._replace(
        time=state.time + ticks * CONTROL_TICK,
        yaw_rate=0.0,
        speed_x=0.0,
        speed_y=0.0,
        speed_z=0.0,
    )


def _read_only(numbers: tuple[float, ...] | FloatArray) -> FloatArray:
    """Make an array read-only."""
    array = np.array(numbers)
    array.flags.writeable = False
    return array
