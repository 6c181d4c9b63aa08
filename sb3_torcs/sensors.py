"""The sensor table, from which all that concerns observations is derived.

Each row is one sensor of the SCR manual (arXiv:1304.1672, table 1). The observation space, the
encoder, the documentation and the policy's view of the observation are all derived from it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import literal_unroll, njit, types
from numba.extending import overload

from sb3_torcs.car import CarState, FloatArray
from sb3_torcs.errors import InvalidOption

__all__ = [
    "OBSERVATION_HIGH",
    "OBSERVATION_LOW",
    "OBSERVATION_SIZE",
    "RANGE_FINDERS",
    "SENSORS",
    "Sensor",
    "encode",
    "encode_record",
    "feature_slices",
    "look_both_ways",
    "range_finder_angles",
    "sensor_table",
]


class Sensor(NamedTuple):
    """A row of the table. An observation holds ``clip(value, low, high) * scale``."""

    name: str  # the field or property of CarState
    key: str  # the SCR server's tag
    size: int
    unit: str
    low: float  # in the unit
    high: float  # in the unit
    scale: float  # from the unit to the observation's number


KMH = 3.6  # km/h per m/s
SCR_RPM = 10.0  # the SCR server reports ten times rad/s as "rpm"

SENSORS = (
    Sensor("heading_error", "angle", 1, "rad", -math.pi, math.pi, 1.0 / math.pi),
    Sensor("range_finders", "track", 19, "m", -1.0, 200.0, 1.0 / 200.0),
    Sensor("track_position", "trackPos", 1, "-", -5.0, 5.0, 1.0),
    Sensor("speed_x", "speedX", 1, "m/s", -100.0, 150.0, KMH / 300.0),
    Sensor("speed_y", "speedY", 1, "m/s", -100.0, 100.0, KMH / 300.0),
    Sensor("speed_z", "speedZ", 1, "m/s", -100.0, 100.0, KMH / 300.0),
    Sensor("wheel_speeds", "wheelSpinVel", 4, "rad/s", -500.0, 1000.0, 1.0 / 100.0),
    Sensor("engine_speed", "rpm", 1, "rad/s", 0.0, 2000.0, SCR_RPM / 10000.0),
)
"""The 29 numbers of "300 lines of python code to demonstrate DDPG with Keras", in its order."""

OBSERVATION_SIZE = sum(sensor.size for sensor in SENSORS)


def _spread(column: str) -> FloatArray:
    """One number per element of the observation, from a column of the table."""
    return np.repeat(
        [float(getattr(sensor, column)) for sensor in SENSORS],
        [sensor.size for sensor in SENSORS],
    )


_SCALE = _spread("scale")
_LOW, _HIGH = _spread("low") * _SCALE, _spread("high") * _SCALE
OBSERVATION_LOW = _LOW.astype(np.float32)
OBSERVATION_HIGH = _HIGH.astype(np.float32)


def feature_slices() -> dict[str, slice]:
    """Return the slice of each sensor in an observation."""
    slices, start = {}, 0
    for sensor in SENSORS:
        slices[sensor.name] = slice(start, start + sensor.size)
        start += sensor.size
    return slices


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
    observation = np.empty(OBSERVATION_SIZE, np.float32)
    done = _scale(_measure(car), observation)
    if done < len(SENSORS):
        name, size = SENSORS[done].name, SENSORS[done].size
        raise ValueError(f"{name} has {np.size(getattr(car, name))} numbers, expected {size}")
    return observation


def sensor_table() -> str:
    """The table as Markdown, for the documentation."""
    lines = [
        "| Num | Sensor | SCR | Unit | Min | Max | Scale | Observation min | Observation max |",
        "|----:|--------|-----|------|----:|----:|------:|----:|----:|",
    ]
    for sensor, where in zip(SENSORS, feature_slices().values(), strict=True):
        number = f"{where.start}" if sensor.size == 1 else f"{where.start}-{where.stop - 1}"
        low, high = sensor.low * sensor.scale, sensor.high * sensor.scale
        lines.append(
            f"| {number} | `{sensor.name}` | `{sensor.key}` | {sensor.unit} | {sensor.low:.5g} | "
            f"{sensor.high:.5g} | {sensor.scale:.5g} | {low:.5g} | {high:.5g} |"
        )
    return "\n".join(lines)


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
    except (TypeError, ValueError):
        raise InvalidOption(f"range_finders is {choice!r}; {allowed}") from None
    if angles.shape != (19,) or not np.all(np.abs(angles) <= 90.0):
        raise InvalidOption(f"range_finders has shape {angles.shape}: {choice!r}; {allowed}")
    return np.radians(angles)


def look_both_ways(angles: FloatArray) -> bool:
    """
    Check whether the angles are symmetric, so that an observation has a mirror image.

    :param angles: (19,) [rad]
    :return: whether they do
    """
    return bool(np.allclose(angles, -angles[::-1]))
