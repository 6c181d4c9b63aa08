"""The state of a car and its controls, the two records that all worlds use, how episodes begin, and
where range finders look.

SI units and radians throughout. Left is positive for steering, lateral position and yaw.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Sequence
from numbers import Integral, Real
from typing import Any, Literal, NamedTuple, TypeVar, get_args

import numpy as np
import numpy.typing as npt

from sb3_torcs.errors import InvalidOption, near_miss

__all__ = [
    "CAR_LENGTH",
    "CAR_NUMBERS",
    "CAR_RECORD",
    "CAR_WIDTH",
    "CONTACTS",
    "CONTROL_TICK",
    "DEFAULT_CAR",
    "FAULTS",
    "FIRST_RIVAL",
    "GAP_AHEAD",
    "GAP_BEHIND",
    "KMH",
    "LAPS_LEFT",
    "LIMITER_RPM",
    "MANY_LAPS",
    "MAX_DAMAGE",
    "MAX_DELAY",
    "MAX_START_SPEED",
    "NO_RACE",
    "RANGE_FINDERS",
    "RESTING",
    "REST_HEIGHT",
    "RIVALS",
    "RPM",
    "STEER_LOCK",
    "CarState",
    "Controls",
    "FloatArray",
    "Range",
    "RangeFinderName",
    "Start",
    "StartName",
    "car_from_record",
    "check_count",
    "checked_choice",
    "checked_delay",
    "checked_factor",
    "checked_flag",
    "checked_from_zero",
    "checked_hard_starts",
    "checked_laps",
    "checked_start",
    "checked_start_speed",
    "controls_from_record",
    "is_count",
    "is_number",
    "is_off_track",
    "look_both_ways",
    "range_finder_angles",
    "track_position",
]

FloatArray = npt.NDArray[np.float64]
Name = TypeVar("Name", bound=str)

DEFAULT_CAR = "car1-trb1"
"""The car of the SCR championship, which all worlds have."""
CAR_LENGTH, CAR_WIDTH = 4.52, 1.94
"""[m] of that car."""
REST_HEIGHT = 0.345
"""[m] of its mass centre over the surface while it stands."""
STEER_LOCK = math.radians(21.0)
"""[rad] of its front wheels, to either side."""
LIMITER_RPM = 9152.0
"""[rpm] at which its motor is limited."""
RPM = math.tau / 60.0
"""[rad/s] One revolution per minute."""
KMH = 3.6
"""[km/h] One metre per second."""

CONTROL_TICK = 0.02
"""[s] The interval at which TORCS calls its robots; one timestep lasts a whole number of them."""


MANY_LAPS = 1 << 30
"""[-] More laps than anyone drives, for a race without an end; the game can count to twice that."""

MAX_DAMAGE = 10000.0
"""[points] At which TORCS takes a car out of the race; its drag has doubled by then."""


def is_number(value: Any) -> bool:
    """Whether a value is a finite real number, NumPy's included, but not a bool."""
    try:
        return not isinstance(value, bool) and isinstance(value, Real) and math.isfinite(value)
    except OverflowError:  # a whole number beyond all floats
        return False


def is_count(value: Any, least: int = 1) -> bool:
    """Whether a value is a whole number, NumPy's included, and not too small; a bool is none."""
    return not isinstance(value, bool) and isinstance(value, Integral) and int(value) >= least


def check_count(name: str, value: Any, most: int | None = None, *, least: int = 1) -> None:
    """
    Make sure that an option is a whole number within bounds.

    :param name: of the option
    :param value: what was given
    :param most: that it may be; ``None`` is any number
    :param least: that it may be
    :raises InvalidOption: if it is not
    """
    if not is_count(value, least):
        raise InvalidOption(f"{name} is {value!r}; expected a whole number >= {least}")
    if most is not None and value > most:
        raise InvalidOption(f"{name} is {value!r}; expected at most {most}")


class Controls(NamedTuple):
    """What the driver asks of the car for the next control ticks."""

    steering: float  # [-] in [-1, 1], 1 is full lock to the left
    throttle: float  # [-] in [0, 1]
    brake: float  # [-] in [0, 1]
    gear: int | None = None  # [-] -1 reverse, 0 neutral; None leaves it to the gearbox
    clutch: float = 0.0  # [-] in [0, 1], 1 is pressed; any gearbox presses it, too, while it shifts


RESTING = Controls(0.0, 0.0, 0.0)
"""Straight on, no pedal: before the first action."""


class Start(NamedTuple):
    """Where and how an episode begins, if not on the grid."""

    distance: float  # [m] along the road's axis from the start line, in [0, track length)
    track_position: float = 0.0  # [-] 0 on the axis, 1 on the left edge, -1 on the right edge
    heading_error: float = 0.0  # [rad] as in CarState
    speed: float = 0.0  # [m/s] along the car's own axis


StartName = Literal["grid", "random"]
STARTS: tuple[str, ...] = get_args(StartName)
"""Where episodes begin."""

MAX_START_SPEED = 150.0  # [m/s] what the observation of the speed can say


def checked_laps(laps: int | None) -> int | None:
    """
    Check the length of a race.

    :param laps: ``None`` drives on
    :return: the same
    :raises InvalidOption: if it is not a possible number of laps
    """
    if laps is None:
        return None
    if not is_count(laps) or laps > MANY_LAPS:
        raise InvalidOption(
            f"laps is {laps!r}; expected a whole number from 1 to {MANY_LAPS}, or None"
        )
    return int(laps)


def checked_from_zero(name: str, value: Any, high: float, allowed: str) -> float:
    """
    Check a number that is 0 or greater.

    :param name: of the option
    :param value: what was given
    :param high: the most that is allowed
    :param allowed: the same in words, for the error
    :raises InvalidOption: if it is no such number
    """
    if not is_number(value) or not 0.0 <= value <= high:
        raise InvalidOption(f"{name} is {value!r}; expected {allowed}")
    return float(value)


def checked_start(start: StartName) -> StartName:
    """
    Check the start of episodes.

    :param start: ``"grid"`` or ``"random"``
    :return: the same
    :raises InvalidOption: for anything else
    """
    return checked_choice("start", start, STARTS)


def checked_start_speed(speed: float) -> float:
    """
    Check the highest speed of random starts.

    :param speed: [m/s]
    :return: the same
    :raises InvalidOption: if no car can start so
    """
    allowed = f"0 to {MAX_START_SPEED:g} m/s"
    return checked_from_zero("speed of random starts", speed, MAX_START_SPEED, allowed)


def checked_choice(name: str, choice: Name, choices: Collection[str]) -> Name:
    """
    Check an option that is one of several names.

    :param name: of the option
    :param choice: one of the names
    :param choices: the names
    :return: the same
    :raises InvalidOption: for anything else
    """
    if not isinstance(choice, str) or choice not in choices:
        *most, last = map(repr, choices)
        advice = f"expected {', '.join(most)} or {last}"
        raise InvalidOption(f"{name} is {choice!r}{near_miss(choice, choices, advice)}")
    return choice


def checked_flag(name: str, choice: bool) -> bool:
    """
    Check an option that is on or off.

    :param name: of the option
    :param choice: ``True`` or ``False``, NumPy's too
    :return: the same
    :raises InvalidOption: for anything else
    """
    if not isinstance(choice, (bool, np.bool_)):
        raise InvalidOption(f"{name} is {choice!r}; expected True or False")
    return bool(choice)


def checked_hard_starts(share: float) -> float:
    """
    Check how many random starts are hard ones.

    :param share: of them, 0 to 1
    :return: the same
    :raises InvalidOption: for anything else
    """
    return checked_from_zero("the share of hard starts", share, 1.0, "0 to 1")


MAX_DELAY = 50  # control ticks: 1 s
LEAST_FACTOR = 0.5  # of grip or mass; ice is another game


class Range(NamedTuple):
    """The bounds of a number that each episode draws; equal ones draw nothing."""

    low: float
    high: float


def checked_range(name: str, choice: Any, low: float, high: float, unit: str) -> Range:
    """
    Check a number, or the two bounds of one that is drawn.

    :param name: of the option
    :param choice: what was given
    :param low: the least that is allowed
    :param high: the most that is allowed
    :param unit: of both, in words
    :raises InvalidOption: if it is no such number
    """
    several = isinstance(choice, Sequence) or np.ndim(choice) > 0
    pair = list(choice) if several else [choice, choice]
    numbers = not isinstance(choice, str) and len(pair) == 2 and all(map(is_number, pair))
    if not numbers or not low <= pair[0] <= pair[1] <= high:
        raise InvalidOption(
            f"{name} is {choice!r}; expected {unit} from {low:g} to {high:g}, or a pair of them, "
            "between which each episode draws"
        )
    return Range(*pair)


def checked_delay(choice: Any) -> Range:
    """
    Check the option ``delay``.

    :param choice: control ticks, or a pair of them
    :raises InvalidOption: if it is no such number
    """
    bounds = checked_range("delay", choice, 0, MAX_DELAY, "whole control ticks")
    if not all(bound == 0 or is_count(bound) for bound in bounds):
        raise InvalidOption(f"delay is {choice!r}; expected whole control ticks of 0.02 s")
    return bounds


def checked_factor(name: str, choice: Any) -> Range:
    """
    Check the option ``grip`` or ``mass``.

    :param name: of the option
    :param choice: a factor, or a pair of them
    :raises InvalidOption: if it is no such number
    """
    return checked_range(name, choice, LEAST_FACTOR, 1.0 / LEAST_FACTOR, "a factor")


RIVALS = 4
"""How many cars around it a car knows."""
GAP_AHEAD, GAP_BEHIND, LAPS_LEFT, CONTACTS, FAULTS = range(5)
"""Where in ``CarState.race`` the numbers of the properties with such names are."""
FIRST_RIVAL = 5
"""Where in ``CarState.race`` their numbers begin: of all of them along the road, across it, ..."""

NO_RACE = np.array([200.0, 200.0, 0.0, 0.0, 0.0, *[200.0] * RIVALS, *[0.0] * 5 * RIVALS])
"""``CarState.race`` of a car that knows of no other, or in a world that does not tell."""
NO_RACE.flags.writeable = False


RangeFinderName = Literal["scr", "narrow"]
RANGE_FINDERS: dict[RangeFinderName, tuple[float, ...]] = {
    "scr": tuple(float(angle) for angle in range(-90, 91, 10)),
    "narrow": (
        -45, -19, -12, -7, -4, -2.5, -1.7, -1, -0.5, 0, 0.5, 1, 1.7, 2.5, 4, 7, 12, 19, 45,
    ),
}  # fmt: skip
"""[deg] left to right: the SCR server's default, and what the original DDPG code asks for."""


def range_finder_angles(choice: RangeFinderName | Sequence[float]) -> FloatArray:
    """
    Resolve the ``range_finders`` option.

    :param choice: ``"scr"``, ``"narrow"``, or 19 angles in degrees, left negative
    :return: (19,) [rad]
    :raises InvalidOption: for anything else
    """
    allowed = 'expected "scr", "narrow", or 19 angles in [-90, 90] degrees, left to right'
    if isinstance(choice, str):
        if choice not in RANGE_FINDERS:
            raise InvalidOption(f"range_finders is {choice!r}; {allowed}")
        choice = RANGE_FINDERS[choice]
    try:
        angles = np.array(choice, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InvalidOption(f"range_finders is {choice!r}; {allowed}") from None
    if angles.shape != (19,) or not np.all(np.abs(angles) <= 90.0):
        what = f"{len(angles)} angles" if angles.ndim == 1 else f"shape {angles.shape}"
        raise InvalidOption(f"range_finders has {what}: {choice!r}; {allowed}")
    return np.radians(angles)


def look_both_ways(angles: FloatArray) -> bool:
    """
    Check whether the angles are symmetric, so that an observation has a mirror image.

    :param angles: (19,) [rad]
    :return: whether they do
    """
    return bool(np.allclose(angles, -angles[::-1]))


class CarState(NamedTuple):
    """
    The car at one moment, as a simulator knows it. Immutable; its arrays are read-only.

    Fields that the SCR server reports follow its definitions (SCR manual, arXiv:1304.1672,
    tables 1 and 2), in SI units.
    """

    time: float  # [s] since the race began
    x: float  # [m] mass centre, in the track's frame
    y: float  # [m]
    yaw: float  # [rad] direction of the car in the track's frame, in [-pi, pi]
    yaw_rate: float  # [rad/s]
    speed_x: float  # [m/s] along the car
    speed_y: float  # [m/s] across the car, left positive
    speed_z: float  # [m/s] upwards
    height: float  # [m] of the mass centre above the surface
    heading_error: float  # [rad] road direction minus yaw, in [-pi, pi]: positive calls for left
    distance_from_axis: float  # [m] left positive
    track_width: float  # [m] of the road where the car is
    distance_from_start: float  # [m] along the axis from the start line, in [0, track length)
    distance_raced: float  # [m] along the axis since the episode began; driving back subtracts
    engine_speed: float  # [rad/s]
    gear: int  # [-] -1 reverse, 0 neutral, 1 and up
    fuel: float  # [l]
    damage: float  # [points]
    laps: int  # whole laps driven
    lap_time: float  # [s] in the current lap
    last_lap_time: float  # [s] of the last whole lap, 0 before there is one
    best_lap_time: float  # [s] of the best whole lap, 0 before there is one
    race_position: int  # 1 is the leader
    wheel_speeds: FloatArray  # (4,) [rad/s] front right, front left, rear right, rear left
    range_finders: FloatArray  # (19,) [m] to the road's edge, left to right; -1 off the road
    opponents: FloatArray  # (36,) [m] to the nearest car per 10 degree sector, 200 if none
    race: FloatArray = NO_RACE  # (29,) what the properties below read, of races of the game

    @property
    def track_position(self) -> float:
        """Lateral position [-]: 0 on the axis, 1 on the left edge, -1 on the right edge."""
        return track_position(self)

    @property
    def off_track(self) -> bool:
        """Whether the mass centre has left the road, as the SCR server judges it."""
        return is_off_track(self)

    @property
    def gap_ahead(self) -> float:
        """To the car a place before [m of road], also if that is out; 200 if this is the first."""
        return float(self.race[GAP_AHEAD])

    @property
    def gap_behind(self) -> float:
        """To the car a place after [m of road], also if that is out; 200 if this is the last."""
        return float(self.race[GAP_BEHIND])

    @property
    def laps_left(self) -> float:
        """Laps until the race ends, the present one included; 2**30 if it does not end."""
        return float(self.race[LAPS_LEFT])

    @property
    def contacts(self) -> float:
        """How often this car and another have touched; 0.5 s apart, it is another contact."""
        return float(self.race[CONTACTS])

    @property
    def faults(self) -> float:
        """In how many of them this car has hit the other one with its front."""
        return float(self.race[FAULTS])


def track_position(car: CarState) -> float:
    """
    Return the lateral position [-]: 0 on the axis, 1 on the left edge, -1 on the right edge.

    Compiled code calls it, too, with a record of a car.

    :param car: any state
    """
    return 2.0 * car.distance_from_axis / car.track_width


def is_off_track(car: CarState) -> bool:
    """
    Check whether the mass centre has left the road. Compiled code calls it, too.

    :param car: any state
    """
    return abs(car.distance_from_axis) > 0.5 * car.track_width


_ARRAYS = {"wheel_speeds": 4, "range_finders": 19, "opponents": 36, "race": len(NO_RACE)}
_COUNTS = tuple(CarState._fields.index(name) for name in ("gear", "laps", "race_position"))
_SCALARS = len(CarState._fields) - len(_ARRAYS)
_ENDS = tuple(itertools.accumulate(_ARRAYS.values()))
_PARTS = tuple(slice(end - size, end) for end, size in zip(_ENDS, _ARRAYS.values(), strict=True))

CAR_RECORD = np.dtype([(name, "f8", _ARRAYS.get(name, ())) for name in CarState._fields])
"""A :class:`CarState` as a record of an array, for many cars at once; the engine writes such."""

CAR_NUMBERS = CAR_RECORD.itemsize // 8
"""[-] numbers of one."""


def car_from_record(numbers: FloatArray) -> CarState:
    """
    Read a car from an array.

    :param numbers: (111,) of a :data:`CAR_RECORD`
    :return: the car, which shares no memory with it
    """
    values = numbers[:_SCALARS].tolist()
    for index in _COUNTS:
        values[index] = int(values[index])
    arrays = numbers[_SCALARS:].copy()
    arrays.flags.writeable = False
    # As CarState(...) does, without the call that a NamedTuple puts in front of it.
    return tuple.__new__(CarState, (*values, *[arrays[part] for part in _PARTS]))


def controls_from_record(numbers: Any) -> Controls:
    """
    Read controls from a record.

    :param numbers: of ``Controls``, with a gear of nan for ``None``
    """
    steering, throttle, brake, gear, clutch = numbers.tolist()
    return Controls(steering, throttle, brake, None if gear != gear else int(gear), clutch)
