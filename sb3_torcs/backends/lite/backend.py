"""The fallback world: a planar race car on a track, with no TORCS installed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sb3_torcs.actions import checked_gearbox
from sb3_torcs.backends.lite import physics
from sb3_torcs.backends.lite.car import TOP_GEAR
from sb3_torcs.backends.lite.rays import RANGE, Edges, road_edges
from sb3_torcs.backends.lite.road import road_width
from sb3_torcs.car import (
    DEFAULT_CAR,
    NO_RACE,
    CarState,
    Controls,
    FloatArray,
    RangeFinderName,
    Start,
    range_finder_angles,
)
from sb3_torcs.errors import CarLost, InvalidOption
from sb3_torcs.torcs.track_names import RANDOM_TRACK
from sb3_torcs.tracks import track as column
from sb3_torcs.tracks.catalogue import load_track
from sb3_torcs.tracks.track import Track

__all__ = ["LiteBackend"]

CARS = (DEFAULT_CAR,)
GROUND_FRICTIONS = [column.ROAD_FRICTION, column.LEFT_FRICTION, column.RIGHT_FRICTION]


class LiteBackend:
    """
    One ``car1-trb1`` alone on a track.

    :param track: a name, a path, a :class:`Track`, or ``"random"`` for a new one each episode
    :param car: ``"car1-trb1"``
    :param range_finders: see :func:`sb3_torcs.car.range_finder_angles`
    :param gearbox: see :data:`sb3_torcs.actions.GEARBOXES`
    """

    gears = TOP_GEAR
    conditions = ("grip",)

    def __init__(
        self,
        track: str | Path | Track = "aalborg",
        *,
        car: str = DEFAULT_CAR,
        range_finders: RangeFinderName | Sequence[float] = "scr",
        gearbox: str = "automatic",
    ) -> None:
        if not isinstance(car, str) or car not in CARS:
            raise InvalidOption(
                f"car is {car!r}; TorcsLite-v0 has {', '.join(CARS)}. The cars of the real game "
                "are those of Torcs-v0"
            )
        self.car = car
        by_road = checked_gearbox(gearbox) == "road_speed"
        self._gearbox = physics.BY_ROAD_SPEED if by_road else physics.AUTOMATIC
        self.range_finder_angles = range_finder_angles(range_finders)
        self._random = isinstance(track, str) and track == RANDOM_TRACK
        self._grip = 1.0
        self._state = np.zeros(physics.STATE_SIZE)
        self._set_track(load_track(track, np.random.default_rng(0) if self._random else None))

    def _set_track(self, track: Track) -> None:
        self.track = track
        self._table: FloatArray = _with_grip(track.table, self._grip)
        self._edges: Edges = road_edges(track)

    def set_conditions(self, grip: float, mass: float) -> None:
        """Change the next episode's world; see :class:`~sb3_torcs.backends.base.Backend`."""
        assert mass == 1.0, "the environment refuses others"
        if grip != self._grip:
            self._grip = grip
            self._table = _with_grip(self.track.table, grip)

    def keep_state_in(self, state: FloatArray) -> None:
        """
        Keep the state of the car in other memory from now on: a fleet has one array for all cars.

        :param state: (STATE_SIZE,) overwritten by the present state
        """
        state[:] = self._state
        self._state = state

    def keeps_state_in(self, state: FloatArray) -> bool:
        """
        Check whether an array holds the state of the car.

        :param state: (STATE_SIZE,)
        """
        return self._state is state

    @property
    def road(self) -> tuple[FloatArray, Edges]:
        """The present track as the physics takes it: its table, and the edges of its road."""
        return self._table, self._edges

    @property
    def gearbox(self) -> int:
        """``AUTOMATIC`` or ``BY_ROAD_SPEED`` of the physics."""
        return self._gearbox

    def draw_track(self, rng: np.random.Generator) -> None:
        """Draw the next episode's track; see :class:`~sb3_torcs.backends.base.Backend`."""
        if self._random:
            self._set_track(load_track(RANDOM_TRACK, rng))

    def reset(self, rng: np.random.Generator, start: Start | None) -> CarState:
        """Begin an episode; see :class:`~sb3_torcs.backends.base.Backend`."""
        del rng  # the track is drawn already, and nothing else is by chance
        track, flying = self.track, start is not None
        if start is None:
            start = Start(track.length - track.grid.distance)
            offset = track.grid.offset
        else:
            segment, along = track.find(start.distance)
            width = road_width(self._table, segment, along)
            offset = 0.5 * start.track_position * width
        x, y, heading = track.pose(start.distance, offset)
        segment, _ = track.find(start.distance)
        yaw = heading - start.heading_error
        self._state[:] = physics.place(x, y, yaw, start.speed, segment, self._table)
        if start.distance == 0.0:
            self._state[physics.CROSSINGS] = 1.0  # on the line itself, the lap has begun
        elif flying:
            self._state[physics.LAPS] = -1.0
        return self._read()

    def step(self, controls: Controls, ticks: int) -> CarState:
        """Drive on; see :class:`~sb3_torcs.backends.base.Backend`."""
        steering, throttle, brake, gear, clutch = controls
        asked = (steering, throttle, brake, self._gearbox if gear is None else gear, clutch)
        physics.advance(self._state, self._table, asked, ticks)
        if not math.isfinite(self._state[physics.X] + self._state[physics.VX]):
            raise self.lost()
        return self._read()

    def lost(self) -> CarLost:
        """Return the error of a car that has no position any more."""
        return CarLost(
            f"the physics has given NaN on {self.track.name}, so the car has no position; see the "
            "surfaces of that track, and call reset to go on"
        )

    def close(self) -> None:
        """Do nothing: the world holds only arrays."""

    def _read(self) -> CarState:
        scalars, wheels, beams = np.empty(physics.SCALARS), np.empty(4), np.empty(19)
        opponents, race = np.full(36, RANGE), NO_RACE.copy()  # there are no other cars
        physics.read(
            self._state, self._table, *self._edges, self.range_finder_angles, scalars, wheels, beams
        )
        for array in (wheels, beams, opponents, race):
            array.flags.writeable = False
        values = scalars.tolist()
        values[physics.GEAR_FIELD] = int(values[physics.GEAR_FIELD])
        values[physics.LAPS_FIELD] = int(values[physics.LAPS_FIELD])
        return CarState._make((*values, 1, wheels, beams, opponents, race))


def _with_grip(table: FloatArray, grip: float) -> FloatArray:
    """Return the table of a track whose ground has another grip."""
    if grip == 1.0:
        return table
    changed = table.copy()
    changed[:, GROUND_FRICTIONS] *= grip
    return changed
