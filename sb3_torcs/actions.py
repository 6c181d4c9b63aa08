"""The three numbers an agent gives, and what the car is told with them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from sb3_torcs.car import Controls, FloatArray
from sb3_torcs.errors import InvalidAction

__all__ = [
    "ACTION_HIGH",
    "ACTION_LOW",
    "ACTUATORS",
    "SHIFT_DOWN",
    "SHIFT_UP",
    "automatic_gear",
    "controls_from_action",
]

ACTUATORS = ("steering", "throttle", "brake")
ACTION_LOW = (-1.0, 0.0, 0.0)
ACTION_HIGH = (1.0, 1.0, 1.0)

_FLOATS = "efd"  # codes of the dtypes that tolist() turns into Python's floats

SHIFT_UP = 8500.0 * 2.0 * math.pi / 60.0
"""[rad/s] ``car1-trb1`` gives its best power at 8,000 rpm and is limited at 9,152."""
SHIFT_DOWN = 7500.0 * 2.0 * math.pi / 60.0
"""[rad/s] Shift down when the lower gear would turn the engine no faster than this."""


def controls_from_action(action: npt.NDArray[np.floating]) -> Controls:
    """
    Turn an agent's action into controls; values outside their range are clipped to it.

    :param action: (3,) steering in [-1, 1], throttle in [0, 1], brake in [0, 1]
    :return: the controls, with the automatic gearbox
    :raises InvalidAction: if the shape is not (3,) or a value is not a number
    """
    if isinstance(action, np.ndarray) and action.shape == (3,) and action.dtype.char in _FLOATS:
        steering, throttle, brake = action.tolist()  # one by one takes twice as long
    else:
        steering, throttle, brake = _three_numbers(action)
    if not (-1.0 <= steering <= 1.0 and 0.0 <= throttle <= 1.0 and 0.0 <= brake <= 1.0):
        for name, value in zip(ACTUATORS, (steering, throttle, brake), strict=True):
            if math.isnan(value):
                raise InvalidAction(
                    f"{name} is nan, expected a number in its range; a network that gives nan has "
                    "diverged: lower learning_rate or check the rewards and observations"
                )
        steering = min(max(steering, -1.0), 1.0)
        throttle = min(max(throttle, 0.0), 1.0)
        brake = min(max(brake, 0.0), 1.0)
    # As Controls(...) does, without the call that a NamedTuple puts in front of it.
    return tuple.__new__(Controls, (steering, throttle, brake, None))


def _three_numbers(action: Any) -> list[float]:
    """Read an action that is no array of floats: a list, whole numbers, or a mistake."""
    try:
        shape: object = np.shape(action)
    except ValueError:  # lists of different lengths
        shape = "of its own"
    if shape != (3,):
        raise InvalidAction(
            f"action has shape {shape}, expected (3,): steering, throttle, brake; "
            "take it from env.action_space.sample() or model.predict(observation)"
        )
    try:
        return [float(value) for value in action]
    except (TypeError, ValueError):
        raise InvalidAction(
            f"action is {action!r}; expected three numbers: steering, throttle, brake"
        ) from None


@njit(cache=True)
def automatic_gear(gear: int, engine_speed: float, ratios: FloatArray) -> int:
    """
    Choose the gear by engine speed. Compiled, and callable from compiled code.

    :param gear: the present gear, -1 reverse, 0 neutral, 1 and up
    :param engine_speed: [rad/s]
    :param ratios: (gears + 2,) gear ratios of reverse, neutral, 1 and up
    :return: the gear to ask for; forward gears only
    """
    if gear < 1:
        return 1
    if engine_speed > SHIFT_UP and gear + 2 < ratios.shape[0]:
        return gear + 1
    if gear > 1 and engine_speed * ratios[gear] / ratios[gear + 1] < SHIFT_DOWN:
        return gear - 1
    return gear
