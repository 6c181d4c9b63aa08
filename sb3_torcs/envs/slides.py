"""How a car that slides is caught before it spins."""

from __future__ import annotations

from sb3_torcs import maths
from sb3_torcs.car import STEER_LOCK, CarState

__all__ = ["caught_steering", "sideslip", "slides"]

atan2, hypot = map(maths.compiled, (maths.atan2, maths.hypot))

SIDESLIP = 0.3  # [rad] from which on a car slides; on asphalt it corners with about 0.1
SLOWEST = 8.0  # [m/s] below which a car that slides comes to a stand soon enough


def sideslip(car: CarState) -> float:
    """
    Return the angle from where a car points to where it goes [rad], left positive.

    Compiled code calls it, too.

    :param car: at the beginning of a timestep
    """
    return atan2(car.speed_y, car.speed_x)


def slides(car: CarState) -> bool:
    """
    Check whether a car slides: its tail has come round so far that it will spin.

    Compiled code calls it, too.

    :param car: at the beginning of a timestep
    """
    if car.gear < 0 or car.speed_x <= 0.0 or hypot(car.speed_x, car.speed_y) < SLOWEST:
        return False
    return abs(sideslip(car)) > SIDESLIP


def caught_steering(car: CarState) -> float:
    """
    Return the steering that points the front wheels where the car goes.

    Leave the pedals alone meanwhile: then the tyres have all of their grip to turn the car back.
    Compiled code calls it, too.

    :param car: that :func:`slides`
    :return: steering as of :class:`~sb3_torcs.car.Controls`
    """
    return min(max(sideslip(car) / STEER_LOCK, -1.0), 1.0)
