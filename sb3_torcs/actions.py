"""Layouts of actions, and how an action becomes controls of the car."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from numbers import Real
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt
from numba import njit
from numba.extending import register_jitable

from sb3_torcs.car import Controls, FloatArray, checked_choice
from sb3_torcs.errors import InvalidAction, InvalidOption, near_miss

__all__ = [
    "ACTIONS",
    "ACTION_HIGH",
    "ACTION_LOW",
    "BRAKE_THRESHOLD",
    "GEARBOXES",
    "GEARS",
    "PEDALS",
    "SHIFT_DOWN_RPM",
    "SHIFT_UP",
    "SHIFT_UP_RPM",
    "ActionLayout",
    "ActionName",
    "GearboxName",
    "action_layout",
    "action_rows",
    "automatic_gear",
    "checked_gearbox",
    "choose_gearbox",
    "controls_from_action",
    "launch_clutch",
    "layout_of_width",
    "list_actions",
    "read_actions",
]

ActionName = Literal["pedals", "pedal", "manual"]
ACTIONS: tuple[str, ...] = get_args(ActionName)
"""Names of the layouts of an action, see :func:`action_layout`."""

GearboxName = Literal["automatic", "road_speed"]
GEARBOXES: tuple[str, ...] = get_args(GearboxName)
"""
What shifts where the action has no gear. Both shift up when the motor would turn faster
than 93 % of its limit, and down when it would turn slower than 82 % in the lower gear.

``"automatic"`` goes by the motor's own speed, which jumps while the wheels spin: then it hunts
between two gears. ``"road_speed"`` goes by the speed that the motor would have if no wheel
slipped; and in first gear it slips the clutch, four fifths pressed at rest and less the faster the
car is, so that the motor has its power from the start.
"""

GEARS = 6
"""Forward gears of a car that says nothing else."""

BRAKE_THRESHOLD = 0.05
"""[-] Brake above which a car counts as braking; networks seldom give exactly 0."""

_DIVERGED = (
    "a network that gives nan has diverged: lower learning_rate or check the rewards and "
    "observations"
)
_FLOATS = "efd"  # codes of the dtypes that tolist() turns into Python's floats
_COUNTS = {2: "two", 3: "three", 5: "five"}

SHIFT_UP_RPM, SHIFT_DOWN_RPM = 8500.0, 7500.0
"""
[rpm] of :data:`~sb3_torcs.car.DEFAULT_CAR`, with its best power at 8,000: the next gear above the
first of them; below the second the gear before, if that would turn the motor no faster.
"""
SHIFT_UP = SHIFT_UP_RPM * math.tau / 60.0
"""[rad/s]"""
SHIFT_DOWN = SHIFT_DOWN_RPM * math.tau / 60.0
"""[rad/s]"""
LAUNCH_CLUTCH = 0.8
"""[-] Clutch of a standing car, by road speed. TORCS passes all torque up to two thirds of it."""
CLUTCH_STEPS = 128.0
"""In which it is pressed, so that who reads the speed in six digits presses the very same."""


@njit(cache=True)
def launch_clutch(engine_speed: float, shift_up: float) -> float:
    """
    Slip the clutch in first gear. Compiled, and callable from compiled code.

    :param engine_speed: what it would be if no wheel slipped, not negative [rad/s]
    :param shift_up: speed of the motor at which the second gear is chosen [rad/s]
    :return: the clutch in [0, 1], 1 is pressed
    """
    launch = LAUNCH_CLUTCH * max(1.0 - engine_speed / shift_up, 0.0)
    return math.floor(launch * CLUTCH_STEPS + 0.5) / CLUTCH_STEPS


class ActionLayout(NamedTuple):
    """How an action is read."""

    names: tuple[str, ...]  # of its numbers
    low: tuple[float, ...]
    high: tuple[float, ...]
    read: Callable[[Sequence[float]], tuple[float, float, float, int | None, float]]
    """From numbers within their limits to the fields of :class:`~sb3_torcs.car.Controls`."""


@register_jitable
def _read_pedals(numbers: Sequence[float]) -> tuple[float, float, float, int | None, float]:
    steering, throttle, brake = numbers
    return steering, throttle, brake, None, 0.0


@register_jitable
def _read_pedal(numbers: Sequence[float]) -> tuple[float, float, float, int | None, float]:
    steering, pedal = numbers
    return steering, pedal if pedal > 0.0 else 0.0, -pedal if pedal < 0.0 else 0.0, None, 0.0


@register_jitable
def _read_manual(numbers: Sequence[float]) -> tuple[float, float, float, int | None, float]:
    steering, throttle, brake, gear, clutch = numbers
    return steering, throttle, brake, math.floor(gear + 0.5), clutch


PEDALS = ActionLayout(
    ("steering", "throttle", "brake"), (-1.0, 0.0, 0.0), (1.0, 1.0, 1.0), _read_pedals
)
"""The layout of the original post."""

ACTION_LOW, ACTION_HIGH = PEDALS.low, PEDALS.high

_PEDAL = ActionLayout(("steering", "pedal"), (-1.0, -1.0), (1.0, 1.0), _read_pedal)
_MANUAL = ("steering", "throttle", "brake", "gear", "clutch")


def action_layout(action: str, gears: int = GEARS) -> ActionLayout:
    """
    Find a layout of the action.

    :param action: ``"pedals"``: steering in [-1, 1], throttle and brake in [0, 1].
        ``"pedal"``: steering and one pedal, both in [-1, 1]; the pedal is throttle above 0 and
        brake below it. ``"manual"``: steering, throttle, brake, a gear from -1 (reverse) over 0
        (neutral) to the highest, rounded to the nearest whole number (halves up), and the clutch
        in [0, 1], 1 is pressed
    :param gears: forward gears of the car
    :return: the layout
    :raises InvalidOption: if there is no such layout
    """
    name = action if isinstance(action, str) else None  # an array would compare one by one
    if name == "pedals":
        return PEDALS
    if name == "pedal":
        return _PEDAL
    if name == "manual":
        low, high = (-1.0, 0.0, 0.0, -1.0, 0.0), (1.0, 1.0, 1.0, float(gears), 1.0)
        return ActionLayout(_MANUAL, low, high, _read_manual)
    advice = f"expected one of {', '.join(map(repr, ACTIONS))}"
    raise InvalidOption(f"action is {action!r}{near_miss(action, ACTIONS, advice)}")


def layout_of_width(width: int) -> ActionLayout | None:
    """
    Tell the layout of an action by how many numbers it has.

    :param width: of the action
    :return: its layout, or ``None`` if none has so many
    """
    layouts = [action_layout(action) for action in ACTIONS]
    return next((layout for layout in layouts if len(layout.names) == width), None)


def checked_gearbox(gearbox: str) -> str:
    """
    Check the choice of a gearbox.

    :param gearbox: one of :data:`GEARBOXES`
    :return: the same
    :raises InvalidOption: for anything else
    """
    return checked_choice("gearbox", gearbox, GEARBOXES)


def choose_gearbox(gearbox: str, action: str) -> str:
    """
    Make sure that the choice of a gearbox has an effect.

    :param gearbox: one of :data:`GEARBOXES`
    :param action: one of :data:`ACTIONS`
    :return: the gearbox
    :raises InvalidOption: if there is no such gearbox, or the agent chooses the gears itself
    """
    checked_gearbox(gearbox)
    if action_layout(action).names == _MANUAL and gearbox != "automatic":
        raise InvalidOption(
            f"gearbox is {gearbox!r}, but action 'manual' chooses the gears itself; leave one of "
            "the two out"
        )
    return gearbox


def controls_from_action(
    action: npt.NDArray[np.floating], layout: ActionLayout = PEDALS
) -> Controls:
    """
    Turn an agent's action into controls; values outside their range are clipped to it.

    :param action: one number for each name of the layout
    :param layout: how to read it
    :return: the controls
    :raises InvalidAction: if the shape is another one or a value is not a number
    """
    names, lows, highs, read = layout
    shape = (len(names),)
    if isinstance(action, np.ndarray) and action.shape == shape and action.dtype.char in _FLOATS:
        numbers = action.tolist()  # one by one takes twice as long
    else:
        numbers = _numbers(action, names)
    for place, (number, low, high) in enumerate(zip(numbers, lows, highs, strict=True)):
        if not low <= number <= high:
            if math.isnan(number):
                raise InvalidAction(
                    f"{names[place]} is nan, expected a number in its range; {_DIVERGED}"
                )
            numbers[place] = min(max(number, low), high)
    # As Controls(...) does, without the call that a NamedTuple puts in front of it.
    return tuple.__new__(Controls, read(numbers))


@njit(cache=True)
def read_actions(asked: Any, low: FloatArray, high: FloatArray, controls: FloatArray) -> bool:
    """
    Turn actions into controls, as :func:`controls_from_action` does for one.

    :param asked: (n, numbers of an action)
    :param low: of the layout
    :param high: of the layout
    :param controls: (n, 5) filled
    :return: whether all are numbers
    """
    numbers = np.empty(len(low))
    for row in range(len(asked)):
        for i in range(len(low)):
            number = float(asked[row, i])
            if number != number:
                return False
            if not low[i] <= number <= high[i]:
                number = min(max(number, low[i]), high[i])
            numbers[i] = number
        shift = np.nan
        if len(low) == 2:
            steering, throttle, brake, _, clutch = _read_pedal((numbers[0], numbers[1]))
        elif len(low) == 3:
            steering, throttle, brake, _, clutch = _read_pedals(
                (numbers[0], numbers[1], numbers[2])
            )
        else:
            steering, throttle, brake, gear, clutch = _read_manual(
                (numbers[0], numbers[1], numbers[2], numbers[3], numbers[4])
            )
            shift = gear
        fields = (steering, throttle, brake, shift, clutch)
        for i in range(5):
            controls[row, i] = fields[i]
    return True


def action_rows(actions: Any, shape: tuple[int, ...]) -> npt.NDArray[np.floating]:
    """
    Make sure that there is an action for each of several environments.

    :param actions: one row per environment
    :param shape: (environments, numbers of an action)
    :return: a copy
    :raises InvalidAction: if the shape is another one or a value is not a number
    """
    try:
        rows = np.array(actions)
        rows = rows if rows.dtype.kind == "f" else rows.astype(np.float64)
    except (TypeError, ValueError):
        rows = np.empty(())
    if rows.shape != shape:
        raise InvalidAction(
            f"actions have shape {rows.shape}; expected {shape}, as of model.predict(observations)"
        )
    if np.isnan(rows).any():
        place = int(np.argwhere(np.isnan(rows))[0, 0])
        raise InvalidAction(f"the action of environment {place} has nan; {_DIVERGED}")
    return rows


def list_actions(actions: Any, shape: tuple[int, ...], advice: str) -> list[Any]:
    """
    Make sure that there is an action for each of several environments, which read their own.

    :param actions: one per environment, each as of :func:`controls_from_action`
    :param shape: (environments, numbers of an action)
    :param advice: where to take them from, for the error
    :return: them
    :raises InvalidAction: if there are more or fewer, or numbers instead of actions
    """
    rows = list(actions) if isinstance(actions, Iterable) else [actions]
    bare = bool(rows) and all(isinstance(row, Real) for row in rows)
    if bare or len(rows) != shape[0]:
        raise InvalidAction(
            f"{len(rows)} {'numbers' if bare else 'actions'} for {shape[0]} environments; expected "
            f"shape {shape}{advice}"
        )
    return rows


def _numbers(action: Any, names: tuple[str, ...]) -> list[float]:
    """Read an action that is not an array of floats: a list, integers, or a mistake."""
    try:
        shape: object = np.shape(action)
    except ValueError:  # lists of different lengths
        shape = "of its own"
    if shape != (len(names),):
        raise InvalidAction(
            f"action has shape {shape}, expected ({len(names)},): {', '.join(names)}; "
            "take it from env.action_space.sample() or model.predict(observation)"
        )
    try:
        if any(isinstance(value, str | bytes) for value in action):
            raise TypeError
        return [float(value) for value in action]
    except (TypeError, ValueError, OverflowError):
        raise InvalidAction(
            f"action is {action!r}; expected {_COUNTS[len(names)]} numbers: {', '.join(names)}"
        ) from None


@njit(cache=True)
def automatic_gear(
    gear: int,
    engine_speed: float,
    ratios: FloatArray,
    shift_up: float = SHIFT_UP,
    shift_down: float = SHIFT_DOWN,
) -> int:
    """
    Choose the gear by motor speed. Compiled, and callable from compiled code.

    :param gear: the present gear, -1 reverse, 0 neutral, 1 and up
    :param engine_speed: the motor's own, or what it would be if no wheel slipped [rad/s]
    :param ratios: (gears,) of the first gear and up
    :param shift_up: above which the next gear comes [rad/s]
    :param shift_down: the gear before comes if it would turn the motor slower than this [rad/s]
    :return: the gear to ask for; forward gears only
    """
    gears = ratios.shape[0]
    if gear < 1:
        return 1
    if engine_speed > shift_up and gear < gears:
        return gear + 1
    if 1 < gear <= gears and engine_speed * ratios[gear - 2] / ratios[gear - 1] < shift_down:
        return gear - 1
    return gear
