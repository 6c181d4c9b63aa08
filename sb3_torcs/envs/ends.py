"""Why an episode ends."""

from __future__ import annotations

import math

from sb3_torcs import maths
from sb3_torcs.car import KMH, MAX_DAMAGE, CarState

__all__ = [
    "GRACE_TICKS",
    "REASONS",
    "STUCK_SPEED",
    "STUCK_TICKS",
    "TRUNCATING",
    "end_of",
    "stands",
    "waited",
]

cos = maths.compiled(maths.cos)

STUCK_SPEED = 5.0 / KMH  # [m/s] along the road; slower than walking counts as standing
STUCK_TICKS = 75  # control ticks of standing that end an episode: 1.5 s
GRACE_TICKS = 150  # 3 s to get going after a standing start
BACKWARDS_ANGLE = 0.5 * math.pi  # [rad] to the road from which the car faces backwards

TRUNCATING = ("laps", "race")
"""The ends of an episode that are no fault of the driver's."""

REASONS = ("", "laps", "off_track", "backwards", "damage")
"""Why an episode ends because of the state of the car, by the index that :func:`end_of` returns."""


def end_of(car: CarState, laps: float, runoff: float, recovery: float) -> int:
    """
    Check whether the state of the car ends the episode. Compiled code calls it, too.

    :param car: at the end of a timestep
    :param laps: whole laps after which the episode ends
    :param runoff: how far the car may be beside the road [m]
    :param recovery: how long a car may be without headway [control ticks]; 0 ends the episode of
        one that faces backwards at once
    :return: the index of the reason in :data:`REASONS`, 0 if the episode goes on
    """
    if car.laps >= laps:
        return 1
    if abs(car.distance_from_axis) > 0.5 * car.track_width + runoff:
        return 2
    if recovery == 0 and abs(car.heading_error) > BACKWARDS_ANGLE:
        return 3
    return 4 if car.damage >= MAX_DAMAGE else 0


def stands(car: CarState) -> bool:
    """
    Check whether a car makes no headway: is slower along the road than walking, or faces backwards.

    Compiled code calls it, too.

    :param car: at the end of a timestep
    """
    along = cos(car.heading_error)
    return along < 0.0 or car.speed_x * along < STUCK_SPEED


def waited(
    car: CarState, standing: int, patience: int, ticks: int, recovery: int
) -> tuple[int, int]:
    """
    Let the clocks of a car that may stand go on. Compiled code calls it, too.

    :param car: at the end of a timestep
    :param standing: for how long it has been standing [control ticks]
    :param patience: for how long it may [control ticks]
    :param ticks: of the timestep
    :param recovery: how long a car may be without headway [control ticks]
    :return: ``standing`` and ``patience`` now; who stands for longer than that is stuck
    """
    if stands(car):
        return standing + ticks, patience
    return 0, max(STUCK_TICKS, recovery)
