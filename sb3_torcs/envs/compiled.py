"""What an environment computes in a timestep, compiled for many environments at once.

The sensors, the terms of rewards, the layouts of actions and the ends of episodes are the functions
that :class:`~sb3_torcs.envs.racing.RacingEnv` calls in Python; numba compiles them here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit, types
from numba.extending import overload_attribute, register_jitable

from sb3_torcs import actions, rewards
from sb3_torcs.car import CarState, FloatArray
from sb3_torcs.envs.aids import aided
from sb3_torcs.envs.ends import end_of, stands, waited
from sb3_torcs.envs.slides import caught_steering, sideslip, slides
from sb3_torcs.envs.unstick import freeing_controls, needs_freeing
from sb3_torcs.rivals import needed_brake, needed_turn
from sb3_torcs.sensors import encode_record

__all__ = ["COMPILED", "RULES", "aid_cars", "read_actions", "value_timesteps"]

RULES = np.dtype(
    [
        ("laps", "f8"),  # after which an episode ends
        ("runoff", "f8"),  # [m] how far a car may be beside the road
        ("recovery", "i8"),  # [control ticks] without headway, 0 for none backwards
        ("ticks", "i8"),  # control ticks of a timestep
        ("patience", "i8"),  # [control ticks] for which a car may stand
        ("standing", "i8"),  # [control ticks] for which it has been standing
    ]
)
"""When the episode of a race ends."""

COMPILED = rewards.OWN_TERMS
"""The terms of rewards of this package. Terms that a user adds are called in Python."""


def _derived(name: str) -> None:
    """Let compiled code read a property of ``CarState`` from records of cars."""
    formula = register_jitable(getattr(CarState, name).fget)

    @overload_attribute(types.Record, name)
    def attribute(car: Any) -> Callable[[Any], Any]:
        del car  # its type alone counts

        def value(car: Any) -> Any:
            return formula(car)

        return value


for _name in ("track_position", "off_track", "gap_ahead", "gap_behind", "contacts", "faults"):
    _derived(_name)
_readers = [actions.action_layout(name).read for name in ("pedals", "pedal", "manual")]
_read_pedals, _read_pedal, _read_manual = _readers
_aids = (
    needed_brake, needed_turn, needs_freeing, freeing_controls, sideslip, slides, caught_steering,
    aided,
)  # fmt: skip
for _function in (end_of, stands, waited, rewards.safe_speed, *_aids, *_readers):
    register_jitable(_function)


@njit(cache=True)
def read_actions(asked: Any, low: FloatArray, high: FloatArray, controls: FloatArray) -> bool:
    """
    Turn actions into controls, as :func:`~sb3_torcs.actions.controls_from_action` does.

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
            shift = gear  # type: ignore[assignment]  # None for no manual layout
        fields = (steering, throttle, brake, shift, clutch)
        for i in range(5):
            controls[row, i] = fields[i]
    return True


@njit(cache=True)
def aid_cars(cars: Any, aids: npt.NDArray[np.bool_], controls: FloatArray) -> None:
    """
    Change controls as :class:`~sb3_torcs.envs.aids.Aids` does.

    :param cars: (n,) at the beginning of a timestep
    :param aids: (n, 4) which cars have which, in the order of :data:`~sb3_torcs.envs.options.AIDS`
    :param controls: (n, 5) that were asked for, changed
    """
    for row in range(len(cars)):
        unstick, keep_distance, keep_clear, catch_slides = aids[row]
        if unstick and needs_freeing(cars[row]):
            steering, throttle, brake, gear = freeing_controls(cars[row])
            fields = (steering, throttle, brake, float(gear), 0.0)
            for i in range(5):
                controls[row, i] = fields[i]
            continue
        asked = (controls[row, 0], controls[row, 1], controls[row, 2])
        steering, throttle, brake = aided(cars[row], asked, keep_distance, keep_clear, catch_slides)
        controls[row, 0], controls[row, 1], controls[row, 2] = steering, throttle, brake


def _one_of(terms: Sequence[rewards.Term]) -> Any:
    """Compile a function that returns the value of one of several terms, by its index."""
    first = njit(terms[0])
    rest = _one_of(terms[1:]) if terms[1:] else None

    @njit
    def value(index: int, before: Any, after: Any, controls: Any) -> float:
        if rest is None or index == 0:
            return first(before, after, controls)
        return rest(index - 1, before, after, controls)

    return value


_term = _one_of(COMPILED)


@njit(cache=True)
def value_timesteps(
    before: Any,
    after: Any,
    controls: Any,
    choices: npt.NDArray[np.int64],
    weights: FloatArray,
    rules: Any,
    observations: npt.NDArray[np.float32],
    terms: FloatArray,
    ended: npt.NDArray[np.bool_],
) -> None:
    """
    Compute observations, terms of the rewards and ends, as ``RacingEnv.finish_step`` does.

    :param before: (n,) cars
    :param after: (n,) cars
    :param controls: (n,) that were asked for, after the aids have changed them
    :param choices: (n, k) indices in :data:`COMPILED`, negative for none
    :param weights: (n, k) of the terms
    :param rules: (n,) of :data:`RULES`, whose clocks are changed
    :param observations: (n, size) whose first 29 numbers are filled
    :param terms: (n, k) filled
    :param ended: (n,) filled
    """
    for race in range(len(after)):
        was, car, rule = before[race], after[race], rules[race]
        encode_record(car, observations[race])
        seconds = car.time - was.time
        for i in range(choices.shape[1]):
            terms[race, i] = 0.0
            if choices[race, i] >= 0 and seconds != 0.0:
                value = _term(choices[race, i], was, car, controls[race])
                terms[race, i] = weights[race, i] * seconds * value
        ended[race] = end_of(car, rule.laps, rule.runoff, rule.recovery) != 0
        if not ended[race]:
            rule.standing, rule.patience = waited(
                car, rule.standing, rule.patience, rule.ticks, rule.recovery
            )
            ended[race] = rule.standing > rule.patience
