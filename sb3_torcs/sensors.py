"""The sensor table, from which all that concerns observations is derived.

Its rows stand in groups, which an environment's ``sensors`` names: ``"base"`` are sensors of the
SCR manual (arXiv:1304.1672, table 1), ``"preview"`` is the road ahead, ``"limits"`` are the speeds
that it allows, ``"line"`` is the racing line, ``"opponents"``, ``"rivals"`` and ``"race"`` are the
other cars, ``"car"`` is the car that is driven, and ``"motion"`` is how the car turns and jumps.
The observation space, the encoder, the mirror image, the documentation and the policy's view of the
observation are all derived from the table.

To add a group, write its rows, put them into :data:`GROUPS`, and its function into ``_WRITERS``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from itertools import accumulate, chain, combinations, pairwise
from operator import attrgetter
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import literal_unroll, njit, types
from numba.extending import overload

from sb3_torcs.car import FIRST_RIVAL, KMH, REST_HEIGHT, RIVALS, CarState, FloatArray
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
    "Sensor",
    "SensorsName",
    "View",
    "checked_sensors",
    "choices_of_size",
    "encode",
    "encode_record",
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
nearly with 1 / speed at which the bend can be driven. Widths are told as their difference from the
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
"""Groups that only a world with a race can tell."""

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
"""What else the car does: how fast it turns, which tells a spin as it begins, and how much higher
it is than at rest, which tells that it is light over a crest, or flies."""

NEEDS_CAR = frozenset({"car"})
"""Groups that only a world that knows its car's file can tell."""

NEEDS_ROAD = frozenset({"preview", "limits", "line", "motion"})
"""Groups that only a world that knows its track can tell: the yaw rate of ``"motion"`` is the turn
of the road and of the car on it, where the SCR protocol tells the latter alone."""

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


_measure = attrgetter(*(sensor.name for sensor in SENSORS))
_SIZES = tuple(sensor.size for sensor in SENSORS)


def _numbers(value: Any) -> Any:
    """Return the values of a sensor as an iterable."""
    return value if isinstance(value, np.ndarray) else (value,)


@overload(_numbers)
def _compiled_numbers(value: Any) -> Callable[[Any], Any]:
    """The same for compiled code, which chooses by type when it is compiled."""

    def several(value: Any) -> Any:
        return value

    def one(value: Any) -> Any:
        return (value,)

    return several if isinstance(value, types.Array) else one


@njit(cache=True)
def _scaled(number: float, index: int) -> float:
    """Return a number of the observation, by its index there."""
    scaled = number * _SCALE[index]
    if scaled <= _LOW[index]:
        return _LOW[index]
    return _HIGH[index] if scaled >= _HIGH[index] else scaled


@njit(cache=True)
def _scale(values: tuple[float | FloatArray, ...], observation: npt.NDArray[np.float32]) -> int:
    """
    Scale and clip. Compiled, since operations on small arrays cost more than what they compute.

    :param values: one number or array per row of the table
    :param observation: (29,) filled
    :return: number of rows before the first whose size differs from the table's
    """
    row = i = 0
    for value in literal_unroll(values):
        numbers = _numbers(value)
        if len(numbers) != _SIZES[row]:
            return row
        row += 1
        for number in numbers:
            observation[i] = _scaled(number, i)
            i += 1
    return row


_NAMES = tuple(sensor.name for sensor in SENSORS)


@njit(cache=True)
def encode_record(car: Any, observation: npt.NDArray[np.float32]) -> None:
    """
    Do what :func:`encode` does, for compiled code.

    :param car: a :data:`~sb3_torcs.car.CAR_RECORD`, whose sizes are those of the table
    :param observation: (29,) filled
    """
    i = 0
    for name in literal_unroll(_NAMES):
        for number in _numbers(getattr(car, name)):
            observation[i] = _scaled(number, i)
            i += 1


def encode(car: CarState) -> npt.NDArray[np.float32]:
    """
    Turn the car's state into an observation.

    :param car: any state
    :return: (29,) numbers within ``OBSERVATION_LOW`` and ``OBSERVATION_HIGH``
    :raises ValueError: if the size of a sensor differs from the table's
    """
    return _encode(car, OBSERVATION_SIZE)


def _encode(car: CarState, size: int) -> npt.NDArray[np.float32]:
    """Make an observation of a size, of which the group ``"base"`` is filled."""
    observation = np.empty(size, np.float32)
    done = _scale(_measure(car), observation)
    if done < len(SENSORS):
        name, expected = SENSORS[done].name, SENSORS[done].size
        raise ValueError(f"{name} has {np.size(getattr(car, name))} numbers, expected {expected}")
    return observation


_PREVIEW_AT = _PARTS["preview"].start


@njit(cache=True)
def _scale_preview(
    sums: FloatArray, step: float, distance: float, numbers: npt.NDArray[np.float32]
) -> None:
    """
    Look ahead, scale and clip.

    :param sums: of the road's profile
    :param step: of the road's profile [m]
    :param distance: of the car from the start line [m]
    :param numbers: of the group ``"preview"``, filled
    """
    means = np.empty((QUANTITIES, INTERVALS))
    look_ahead(sums, step, distance, means)
    width = means[1, 0]
    for i in range(INTERVALS):
        means[0, i] /= abs(means[0, i]) + USUAL_BEND
        means[1, i] -= width
    for i in range(means.size):
        numbers[i] = _scaled(means[i // INTERVALS, i % INTERVALS], _PREVIEW_AT + i)


def _profile(world: Any) -> RoadProfile:
    """The road of a world, with hills if it has some."""
    return getattr(world, "profile", None) or world.track.profile


def _write_preview(world: Any, car: CarState, numbers: npt.NDArray[np.float32]) -> None:
    road = _profile(world)
    _scale_preview(road.sums, road.step, car.distance_from_start, numbers)


@njit(cache=True)
def _scale_into(values: FloatArray, first: int, numbers: npt.NDArray[np.float32]) -> None:
    """Scale and clip values of a group, whose place in the table is given."""
    for i in range(len(values)):
        numbers[i] = _scaled(values[i], first + i)


def _write_limits(world: Any, car: CarState, numbers: npt.NDArray[np.float32]) -> None:
    road = _profile(world)
    margins = np.empty(INTERVALS)
    speed_margins(road.sums, road.step, car.distance_from_start, car.speed_x, margins)
    _scale_into(margins, _PARTS["limits"].start, numbers)


def _write_line(world: Any, car: CarState, numbers: npt.NDArray[np.float32]) -> None:
    table, step = racing_line(_profile(world))
    seen = np.empty((3, LINE_PLACES))
    look_along(table, step, car.distance_from_start, car.track_position, car.speed_x, seen)
    seen[1] /= np.abs(seen[1]) + USUAL_BEND
    _scale_into(seen.ravel(), _PARTS["line"].start, numbers)


def _write_opponents(_world: Any, car: CarState, numbers: npt.NDArray[np.float32]) -> None:
    _scale_into(car.opponents, _PARTS["opponents"].start, numbers)


def _write_rivals(_world: Any, car: CarState, numbers: npt.NDArray[np.float32]) -> None:
    _scale_into(see_rivals(car.race[FIRST_RIVAL:]), _PARTS["rivals"].start, numbers)


def _write_race(_world: Any, car: CarState, numbers: npt.NDArray[np.float32]) -> None:
    values = np.array([car.race_position, car.gap_ahead, car.gap_behind, car.laps_left], np.float64)
    _scale_into(values, _PARTS["race"].start, numbers)


def _write_car(world: Any, _car: CarState, numbers: npt.NDArray[np.float32]) -> None:
    _scale_into(np.array(world.facts), _PARTS["car"].start, numbers)


def _write_motion(_world: Any, car: CarState, numbers: npt.NDArray[np.float32]) -> None:
    values = np.array([car.yaw_rate, car.height - REST_HEIGHT])
    _scale_into(values, _PARTS["motion"].start, numbers)


_WRITERS: dict[str, Callable[[Any, CarState, npt.NDArray[np.float32]], None]] = {
    "preview": _write_preview,
    "limits": _write_limits,
    "line": _write_line,
    "opponents": _write_opponents,
    "rivals": _write_rivals,
    "race": _write_race,
    "car": _write_car,
    "motion": _write_motion,
}
"""Of each group but ``"base"``: fills its numbers, from the world and the state of the car."""


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
        ends = accumulate(part.stop - part.start for part in parts)
        self._more = [
            (_WRITERS[name], slice(begin, end))
            for name, (begin, end) in zip(self.sensors[1:], pairwise(ends), strict=True)
        ]

    @property
    def has_more(self) -> bool:
        """Whether there are groups besides ``"base"``."""
        return len(self._more) > 0

    def encode(self, car: CarState, world: Any) -> npt.NDArray[np.float32]:
        """
        Turn a state into an observation.

        :param car: the agent's
        :param world: in which it drives
        :return: (size,) numbers within ``low`` and ``high``
        """
        observation = _encode(car, self.size)
        self.add(car, world, observation)
        return observation

    def add(self, car: CarState, world: Any, observation: npt.NDArray[np.float32]) -> None:
        """
        Fill the groups of an observation that come after ``"base"``.

        :param car: the agent's
        :param world: in which it drives
        :param observation: (size,)
        """
        for write, where in self._more:
            write(world, car, observation[where])
