"""The sensor table, from which all that concerns observations is derived.

Its rows stand in groups, which an environment's ``sensors`` names: ``"base"`` are sensors of the
SCR manual (arXiv:1304.1672, table 1), ``"preview"`` is the road ahead, ``"limits"`` are the speeds
that it allows, ``"line"`` is the racing line, ``"opponents"``, ``"rivals"`` and ``"race"`` are the
other cars, ``"car"`` is the car that is driven, and ``"motion"`` is how the car turns and jumps.
The observation space, the encoder, the mirror image, the documentation and the policy's view of the
observation are all derived from the table.

To add a group, write its rows, put them into :data:`GROUPS`, and its functions into ``_FILLERS``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from itertools import accumulate, chain, combinations
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit
from numba.extending import register_jitable

from sb3_torcs.car import (
    CAR_RECORD,
    FIRST_RIVAL,
    GAP_AHEAD,
    GAP_BEHIND,
    KMH,
    LAPS_LEFT,
    REST_HEIGHT,
    RIVALS,
    CarState,
    FloatArray,
    track_position,
)
from sb3_torcs.errors import InvalidOption, near_miss
from sb3_torcs.rivals import see_rivals
from sb3_torcs.tracks.profile import RoadProfile
from sb3_torcs.tracks.racing_line import LINE_PLACES, look_along, racing_line
from sb3_torcs.tracks.view_ahead import INTERVALS, QUANTITIES, look_ahead, speed_margins

__all__ = [
    "GROUPS",
    "NEEDS_CAR",
    "NEEDS_RACE",
    "NEEDS_ROAD",
    "OBSERVATION_HIGH",
    "OBSERVATION_LOW",
    "OBSERVATION_SIZE",
    "SCR_RPM",
    "SENSORS",
    "Eyes",
    "Sensor",
    "SensorsName",
    "View",
    "checked_sensors",
    "choices_of_size",
    "encode",
    "feature_slices",
    "view_of",
]

SensorsName = Literal[
    "base", "preview", "limits", "line", "opponents", "rivals", "race", "car", "motion"
]
Mirror = Literal["same", "opposite", "reversed", "sides"]


class Sensor(NamedTuple):
    """A row of the table. An observation holds ``clip(value, low, high) * scale``."""

    name: str  # in the group "base" the field or property of CarState
    key: str  # the SCR server's tag, empty for what it does not send
    size: int
    unit: str
    low: float  # in the unit
    high: float  # in the unit
    scale: float  # from the unit to the observation's number
    mirror: Mirror = "same"  # what becomes of its numbers if left and right change places


SCR_RPM = 10.0  # the SCR server reports ten times rad/s as "rpm"

SENSORS = (
    Sensor("heading_error", "angle", 1, "rad", -math.pi, math.pi, 1.0 / math.pi, "opposite"),
    Sensor("range_finders", "track", 19, "m", -1.0, 200.0, 1.0 / 200.0, "reversed"),
    Sensor("track_position", "trackPos", 1, "-", -5.0, 5.0, 1.0, "opposite"),
    Sensor("speed_x", "speedX", 1, "m/s", -100.0, 150.0, KMH / 300.0),
    Sensor("speed_y", "speedY", 1, "m/s", -100.0, 100.0, KMH / 300.0, "opposite"),
    Sensor("speed_z", "speedZ", 1, "m/s", -100.0, 100.0, KMH / 300.0),
    Sensor("wheel_speeds", "wheelSpinVel", 4, "rad/s", -500.0, 1000.0, 1.0 / 100.0, "sides"),
    Sensor("engine_speed", "rpm", 1, "rad/s", 0.0, 2000.0, SCR_RPM / 10000.0),
)
"""The 29 numbers of "300 lines of python code to demonstrate DDPG with Keras", in its order."""

OBSERVATION_SIZE = sum(sensor.size for sensor in SENSORS)

PREVIEW = (
    Sensor("bends_ahead", "", INTERVALS, "-", -1.0, 1.0, 1.0, "opposite"),
    Sensor("widths_ahead", "", INTERVALS, "m", -20.0, 20.0, 1.0 / 10.0),
    Sensor("slopes_ahead", "", INTERVALS, "m/m", -0.4, 0.4, 5.0),
)
"""The road ahead, in the mean over intervals that are short near the car and long far from it.

Of a bend with the radius R it shows 50 m / (50 m + R), positive to the left. So the whole range
from a straight to a hairpin lies in (-1, 1), changes smoothly while the car moves on, and goes
nearly with 1 / speed at which the bend can be driven. Widths are shown as their difference from the
first interval's: most roads are equally wide everywhere, and many inputs that stay the same disturb
learning.
"""
USUAL_BEND = 1.0 / 50.0  # [1/m] seen as 0.5

LIMITS = (Sensor("speed_margins_ahead", "", INTERVALS, "m/s", -40.0, 40.0, 1.0 / 20.0),)
"""By how much the car may be faster now, in the light of each interval of the road ahead: below 0
it has to brake. Bends are taken at 15 m/s² and brakes slow down by 10 m/s². A car on asphalt can do
more, so that an agent learns how much more is possible."""

LINE = (
    Sensor("line_offsets", "", LINE_PLACES, "m", -20.0, 20.0, 1.0 / 5.0, "opposite"),
    Sensor("line_bends", "", LINE_PLACES, "-", -1.0, 1.0, 1.0, "opposite"),
    Sensor("line_margins", "", LINE_PLACES, "m/s", -40.0, 40.0, 1.0 / 20.0),
)
"""The racing line ahead: how far to the left of the car it lies, how it bends, in the terms of
``bends_ahead``, and by how much the car may be faster now to drive it, in the terms of
``speed_margins_ahead``, but on this surface, with its hills and banking."""

OPPONENTS = (Sensor("opponents", "opponents", 36, "m", 0.0, 200.0, 1.0 / 200.0, "reversed"),)
"""Distances to the nearest car in sectors of 10°, clockwise; the first begins straight behind."""

RIVAL_ROWS = (
    Sensor("rivals_along", "", RIVALS, "-", -1.0, 1.0, 1.0),
    Sensor("rivals_across", "", RIVALS, "-", -1.0, 1.0, 1.0, "opposite"),
    Sensor("rivals_speed_along", "", RIVALS, "m/s", -60.0, 60.0, 1.0 / 10.0),
    Sensor("rivals_speed_across", "", RIVALS, "m/s", -30.0, 30.0, 1.0 / 10.0, "opposite"),
    Sensor("rivals_urgency", "", RIVALS, "-", 0.0, 2.0, 1.0),
    Sensor("rivals_beside", "", RIVALS, "-", -1.0, 1.0, 1.0, "opposite"),
)
"""The cars that are nearest along the road, the nearest first: where they are against this one, how
much faster, how urgent it is to brake for them, and how close they are beside.

A distance d along the road is shown as d / (10 m + |d|), one across as d / (3 m + |d|), so that a
metre counts most where cars are close. These and the speeds fade with the distance along the road,
to 0 at 80 m. So nothing jumps when a car comes near, and who is alone sees zeros. The urgency is 1
at the speed from which 15 m/s² avoid a car ahead that goes on as it does, and 0 at 20 m/s less. A
car beside is seen as 1, or -1 to the right, where it touches, and as 0 from two metres.
"""

RACE = (
    Sensor("race_position", "racePos", 1, "-", 1.0, 20.0, 1.0 / 20.0),
    Sensor("gap_ahead", "", 1, "m", 0.0, 200.0, 1.0 / 200.0),
    Sensor("gap_behind", "", 1, "m", 0.0, 200.0, 1.0 / 200.0),
    Sensor("laps_left", "", 1, "-", 0.0, 10.0, 1.0 / 10.0),
)
"""How the race stands. Gaps are those to the car a place before and after."""

NEEDS_RACE = frozenset({"rivals", "race"})
"""Groups that need a world with a race."""

CAR = (
    Sensor("car_grip", "", 1, "-", 0.0, 3.0, 1.0 / 1.5),
    Sensor("car_downforce", "", 1, "1/m", 0.0, 0.01, 500.0),
    Sensor("car_power", "", 1, "W/kg", 0.0, 1500.0, 1.0 / 300.0),
    Sensor("car_drag", "", 1, "1/m", 0.0, 0.0025, 2000.0),
    Sensor("car_mass", "", 1, "kg", 0.0, 4000.0, 1.0 / 1000.0),
    Sensor("car_steer", "", 1, "rad", 0.0, 1.5, 1.0 / 0.4),
)
"""The car that is driven, by its file, so that one agent can drive many: the fields of
:class:`~sb3_torcs.torcs.car_file.CarFacts`. They stay the same all through an episode: the factors
``mass`` and ``grip`` of an episode's conditions are not in them, nor fuel that is burnt."""

MOTION = (
    Sensor("yaw_rate", "", 1, "rad/s", -5.0, 5.0, 1.0, "opposite"),
    Sensor("lift", "", 1, "m", -0.5, 1.0, 10.0),
)
"""What else the car does: how fast it turns, which shows a spin as it begins, and how much higher
it is than at rest, which shows that it is light over a crest, or flies."""

NEEDS_CAR = frozenset({"car"})
"""Groups that need a world that knows its car's file."""

NEEDS_ROAD = frozenset({"preview", "limits", "line", "motion"})
"""Groups that need a world that knows its track: the yaw rate of ``"motion"`` is the turn
of the road and of the car on it, where the SCR protocol sends the latter alone."""

GROUPS: Mapping[SensorsName, tuple[Sensor, ...]] = {
    "base": SENSORS,
    "preview": PREVIEW,
    "limits": LIMITS,
    "line": LINE,
    "opponents": OPPONENTS,
    "rivals": RIVAL_ROWS,
    "race": RACE,
    "car": CAR,
    "motion": MOTION,
}
"""The whole table. An observation has the groups that are named, in this order."""

_TABLE = tuple(chain(*GROUPS.values()))
_ENDS = tuple(accumulate(sum(sensor.size for sensor in rows) for rows in GROUPS.values()))
_PARTS = dict(zip(GROUPS, map(slice, (0, *_ENDS), _ENDS), strict=True))
"""The place of each group in an observation with all of them."""


def _spread(column: str) -> FloatArray:
    """One number per element of an observation with all groups, from a column of the table."""
    values = [float(getattr(sensor, column)) for sensor in _TABLE]
    return np.repeat(values, [sensor.size for sensor in _TABLE])


_SCALE = _spread("scale")
_LOW, _HIGH = _spread("low") * _SCALE, _spread("high") * _SCALE
OBSERVATION_LOW = _LOW[:OBSERVATION_SIZE].astype(np.float32)
OBSERVATION_HIGH = _HIGH[:OBSERVATION_SIZE].astype(np.float32)


def checked_sensors(
    sensors: Sequence[SensorsName], option: str = "sensors"
) -> tuple[SensorsName, ...]:
    """
    Check a choice of groups.

    :param sensors: names of groups, ``"base"`` among them
    :param option: that chooses them, for the message
    :return: the same in the order of the table
    :raises InvalidOption: if one is unknown or missing
    """
    listed = isinstance(sensors, Sequence) and not isinstance(sensors, (str, bytes))
    names = [name for name in GROUPS if listed and name in sensors]
    if "base" not in names or len(names) < len(sensors):
        others = ", ".join(repr(name) for name in GROUPS if name != "base")
        advice = f"expected a list with 'base', and any of {others}, each once"
        unknown = next((str(name) for name in sensors if name not in names), "") if listed else ""
        hint = near_miss(unknown, GROUPS, advice)
        raise InvalidOption(f"{option} is {sensors!r}{hint}")
    return tuple(names)


def feature_slices(sensors: Sequence[SensorsName] = ("base",)) -> dict[str, slice]:
    """
    Return the slice of each sensor in an observation.

    :param sensors: names of its groups
    """
    slices, start = {}, 0
    for sensor in chain(*(GROUPS[name] for name in checked_sensors(sensors))):
        slices[sensor.name] = slice(start, start + sensor.size)
        start += sensor.size
    return slices


@lru_cache
def choices_of_size(size: int) -> tuple[View, ...]:
    """
    Find the choices of groups whose observations have a size. Few sizes have more than one.

    :param size: of an observation
    :return: each such choice
    """
    more = chain(*(combinations(list(GROUPS)[1:], n) for n in range(len(GROUPS))))
    views = (View(("base", *groups)) for groups in more)
    return tuple(view for view in views if view.size == size)


def view_of(space: Any) -> View | None:
    """
    Find the choice of groups whose observations have the bounds of a space.

    Several choices may have one size, and so may stacked frames: the bounds decide.

    :param space: of the observations, a ``Box``; or a :class:`View`
    :return: the choice; ``None`` if there is none
    """
    bounds = np.array((getattr(space, "low", ()), getattr(space, "high", ())), np.float32)
    views = choices_of_size(bounds.shape[1]) if bounds.ndim == 2 else ()
    return next((v for v in views if np.array_equal((v.low, v.high), bounds)), None)


register_jitable(track_position)

Rows = npt.NDArray[np.int64]
Constants = tuple[Any, ...]
"""What a group needs of a world, the same all through an episode: an array first, if anything."""
Job = tuple[Callable[..., None], Rows, int, Constants]
"""Fills the numbers of a group, of which cars, from where in an observation, with what."""


@register_jitable
def _copy(numbers: FloatArray, values: FloatArray, at: int) -> None:
    """Do what ``values[at:at + len(numbers)] = numbers`` does, which takes long to compile."""
    for i in range(len(numbers)):
        values[at + i] = numbers[i]


def _write_base(car: CarState, values: FloatArray) -> None:
    values[0] = car.heading_error
    _copy(car.range_finders, values, 1)
    values[20] = track_position(car)
    values[21] = car.speed_x
    values[22] = car.speed_y
    values[23] = car.speed_z
    _copy(car.wheel_speeds, values, 24)
    values[28] = car.engine_speed


def _write_preview(car: CarState, values: FloatArray, sums: FloatArray, step: float) -> None:
    means = np.empty((QUANTITIES, INTERVALS))
    look_ahead(sums, step, car.distance_from_start, means)
    width = means[1, 0]
    for i in range(INTERVALS):
        values[i] = means[0, i] / (abs(means[0, i]) + USUAL_BEND)
        values[INTERVALS + i] = means[1, i] - width
        values[2 * INTERVALS + i] = means[2, i]


def _write_limits(car: CarState, values: FloatArray, sums: FloatArray, step: float) -> None:
    speed_margins(sums, step, car.distance_from_start, car.speed_x, values)


def _write_line(car: CarState, values: FloatArray, table: FloatArray, step: float) -> None:
    seen = values.reshape((3, LINE_PLACES))
    look_along(table, step, car.distance_from_start, track_position(car), car.speed_x, seen)
    for i in range(LINE_PLACES):
        seen[1, i] /= abs(seen[1, i]) + USUAL_BEND


def _write_opponents(car: CarState, values: FloatArray) -> None:
    _copy(car.opponents, values, 0)


def _write_rivals(car: CarState, values: FloatArray) -> None:
    _copy(see_rivals(car.race[FIRST_RIVAL:]), values, 0)


def _write_race(car: CarState, values: FloatArray) -> None:
    values[0], values[1] = car.race_position, car.race[GAP_AHEAD]
    values[2], values[3] = car.race[GAP_BEHIND], car.race[LAPS_LEFT]


def _write_car(_car: CarState, values: FloatArray, facts: FloatArray) -> None:
    _copy(facts, values, 0)


def _write_motion(car: CarState, values: FloatArray) -> None:
    values[0], values[1] = car.yaw_rate, car.height - REST_HEIGHT


def _nothing(_world: Any) -> Constants:
    return ()


def _road(world: Any) -> RoadProfile:
    """The road of a world, with hills if it has some."""
    return getattr(world, "profile", None) or world.track.profile


def _profile(world: Any) -> Constants:
    road = _road(world)
    return road.sums, road.step


def _line(world: Any) -> Constants:
    return tuple(racing_line(_road(world)))


def _facts(world: Any) -> Constants:
    return (_numbers(world.facts),)


@lru_cache
def _numbers(facts: tuple[float, ...]) -> FloatArray:
    return np.array(facts)


_FILLERS: Mapping[SensorsName, tuple[Callable[..., None], Callable[[Any], Constants]]] = {
    "base": (_write_base, _nothing),
    "preview": (_write_preview, _profile),
    "limits": (_write_limits, _profile),
    "line": (_write_line, _line),
    "opponents": (_write_opponents, _nothing),
    "rivals": (_write_rivals, _nothing),
    "race": (_write_race, _nothing),
    "car": (_write_car, _facts),
    "motion": (_write_motion, _nothing),
}
"""Of each group: a function that writes its values in the table's units, from a car and what it
needs of the car's world; and one that returns that. The first is compiled."""


@njit(cache=True)
def _scaled(number: float, index: int) -> float:
    """Return a number of the observation, by its index in the table."""
    scaled = number * _SCALE[index]
    if scaled <= _LOW[index]:
        return _LOW[index]
    return _HIGH[index] if scaled >= _HIGH[index] else scaled


@lru_cache
def _compiled(name: SensorsName) -> Callable[..., None]:
    """
    Compile what fills the numbers of a group in the observations of many cars.

    :param name: of the group
    """
    write = register_jitable(_FILLERS[name][0])
    first, size = _PARTS[name].start, _PARTS[name].stop - _PARTS[name].start

    @njit(cache=True)
    def fill(
        cars: Any,
        rows: Rows,
        at: int,
        observations: npt.NDArray[np.float32],
        *constants: Any,
    ) -> None:
        values = np.empty(size)
        for row in rows:
            write(cars[row].car, values, *constants)
            for i in range(size):
                observations[row, at + i] = _scaled(values[i], first + i)

    return fill


class View:
    """
    What an agent sees: some groups of the table.

    :param sensors: names of the groups, ``"base"`` among them
    :raises InvalidOption: if one is unknown or missing
    """

    def __init__(self, sensors: Sequence[SensorsName] = ("base",)) -> None:
        self.sensors = checked_sensors(sensors)
        parts = [_PARTS[name] for name in self.sensors]
        low, high = ([bound[part] for part in parts] for bound in (_LOW, _HIGH))
        self.low = np.concatenate(low).astype(np.float32)
        self.high = np.concatenate(high).astype(np.float32)
        self.size = len(self.low)

    def encode(self, car: CarState, world: Any) -> npt.NDArray[np.float32]:
        """
        Turn one state into an observation. :class:`Eyes` does so for many, and faster.

        :param car: the agent's
        :param world: in which it drives
        :return: (size,) numbers within ``low`` and ``high``
        :raises ValueError: if an array of the state has another size than in ``CAR_RECORD``
        """
        cars = np.empty(1, [("car", CAR_RECORD)])
        cars["car"] = car
        eyes = Eyes(self, 1)
        eyes.open(0, world)
        return eyes.see(cars)[0]


class Eyes:
    """
    Makes the observations of some cars, each in a world.

    :param view: what all of them see
    :param number: of the cars
    """

    def __init__(self, view: View, number: int) -> None:
        self._view = view
        self._constants: list[list[Constants]] = [[()] * number for _ in view.sensors]
        self._jobs: list[list[Job]] = [[] for _ in view.sensors]

    def open(self, index: int, world: Any) -> None:
        """
        Begin an episode of one car.

        :param index: of the car
        :param world: in which it drives until the next call
        """
        for place, name in enumerate(self._view.sensors):
            before, constants = self._constants[place][index], _FILLERS[name][1](world)
            if _key(before) != _key(constants):
                self._jobs[place] = []
            self._constants[place][index] = constants

    def see(self, cars: Any) -> npt.NDArray[np.float32]:
        """
        Turn states into observations.

        :param cars: (number,) records with a field ``car``, a :data:`~sb3_torcs.car.CAR_RECORD`
        :return: (number, size) numbers within ``low`` and ``high`` of the view
        """
        observations = np.empty((len(cars), self._view.size), np.float32)
        for place, jobs in enumerate(self._jobs):
            for fill, rows, at, constants in jobs or self._plan(place):
                fill(cars, rows, at, observations, *constants)
        return observations

    def _plan(self, place: int) -> list[Job]:
        """Find which cars share what a group needs of a world: one call fills it for them all."""
        each, sensors = self._constants[place], self._view.sensors
        shared: dict[int, list[int]] = {}
        for index, constants in enumerate(each):
            shared.setdefault(_key(constants), []).append(index)
        fill = _compiled(sensors[place])
        at = sum(_PARTS[name].stop - _PARTS[name].start for name in sensors[:place])
        self._jobs[place] = [(fill, np.array(rows), at, each[rows[0]]) for rows in shared.values()]
        return self._jobs[place]


def _key(constants: Constants) -> int:
    """Distinguish constants of one world from those of another: by the array that comes first."""
    return id(constants[0]) if constants else 0


def encode(car: CarState) -> npt.NDArray[np.float32]:
    """
    Turn the car's state into an observation of the group ``"base"``.

    :param car: any state
    :return: (29,) numbers within ``OBSERVATION_LOW`` and ``OBSERVATION_HIGH``
    :raises ValueError: if an array of the state has another size than in ``CAR_RECORD``
    """
    return View().encode(car, None)
