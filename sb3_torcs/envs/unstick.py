"""How a stuck car comes free, as the game's robots do it."""

from __future__ import annotations

import math

from sb3_torcs import maths
from sb3_torcs.car import CarState

__all__ = ["freeing_controls", "needs_freeing"]

hypot = maths.compiled(maths.hypot)

TURNED = math.pi / 6.0  # [rad] to the road from which a car stands across it
SLOW = 5.0  # [m/s] below which a car is stuck that stands across the road, or beside it
CREEP = 4.0  # [m/s] at most, forward and backward
CREEP_THROTTLE, STOP_BRAKE = 1.0, 0.8
# How far beyond the axis a car goes on in its direction, since each change of it takes a second:
# share of half the road.
OVER_AXIS = 0.5
BACK = 0.35  # [rad] at which a car comes back from beside the road
BACK_STEERING = 2.0  # [-] per radian


def needs_freeing(car: CarState) -> bool:
    """
    Check whether a car is stuck: slow, or in reverse, and across the road or beside it.

    Compiled code calls it, too.

    :param car: at the beginning of a timestep
    """
    if abs(car.heading_error) < TURNED and abs(car.track_position) <= 1.0:
        return False
    return car.gear < 0 or hypot(car.speed_x, car.speed_y) < SLOW


def freeing_controls(car: CarState) -> tuple[float, float, float, int]:
    """
    Turn a car towards the road, forward while its nose points to the axis and else backward; from
    beside the road drive back to it.

    To turn is the rule of the driver that comes with the Simulated Car Racing championship's
    software (Loiacono, Cardamone and Lanzi, "Simulated Car Racing Championship: Competition
    Software Manual", 2013, arXiv:1304.1672), but slow. Compiled code calls it, too.

    :param car: that :func:`needs_freeing`
    :return: steering, throttle, brake and gear as of :class:`~sb3_torcs.car.Controls`
    """
    if abs(car.heading_error) < TURNED:
        wanted = BACK if car.track_position > 0.0 else -BACK
        steering = BACK_STEERING * (car.heading_error - wanted)
        return min(max(steering, -1.0), 1.0), CREEP_THROTTLE, 0.0, 1
    side = 1.0 if car.heading_error > 0.0 else -1.0
    forward = side * car.track_position > (OVER_AXIS if car.gear < 0 else -OVER_AXIS)
    way = 1.0 if forward else -1.0
    throttle = brake = 0.0
    if car.speed_x * way < -1.0:
        brake = STOP_BRAKE
    elif car.speed_x * way < CREEP:
        throttle = CREEP_THROTTLE
    return side * way, throttle, brake, 1 if forward else -1
