"""What a car does by itself, whatever it is asked: driver aids."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from numba import njit
from numba.extending import register_jitable

from sb3_torcs import maths
from sb3_torcs.car import STEER_LOCK, CarState, track_position
from sb3_torcs.envs.episode import Episodes
from sb3_torcs.envs.options import AIDS, AidName, checked_aids
from sb3_torcs.rivals import needed_brake, needed_turn

__all__ = ["NEED_RIVALS", "Aids", "help_cars", "parse_aids"]

atan2, hypot = map(maths.compiled, (maths.atan2, maths.hypot))

STUCK_ANGLE = math.pi / 6.0  # [rad] to the road from which a car stands across it
STUCK_SPEED = 5.0  # [m/s] below which a car is stuck that stands across the road, or beside it
CREEP = 4.0  # [m/s] at most, forward and backward
CREEP_THROTTLE, STOP_BRAKE = 1.0, 0.8
# How far beyond the axis a car goes on in its direction, since each change of it takes a second:
# share of half the road.
OVER_AXIS = 0.5
BACK = 0.35  # [rad] at which a car comes back from beside the road
BACK_STEERING = 2.0  # [-] per radian

SIDESLIP = 0.3  # [rad] from which on a car slides; on asphalt it corners with about 0.1
LEAST_SPEED = 8.0  # [m/s] below which a car that slides stands soon enough


@dataclass
class Aids:
    """The driver aids of a car."""

    unstick: bool  # a car that is stuck frees itself
    keep_distance: bool  # it brakes by itself for the car ahead
    keep_clear: bool  # it steers away by itself from those beside it
    catch_slides: bool  # it steers against a slide, before it spins

    @classmethod
    def of(cls, names: Iterable[AidName]) -> Aids:
        """
        Make the aids of these names.

        :param names: any of :data:`~sb3_torcs.envs.options.AIDS`
        """
        return cls(*(name in names for name in AIDS))

    @property
    def names(self) -> tuple[AidName, ...]:
        """The names of these aids."""
        return tuple(name for name in AIDS if getattr(self, name))


@register_jitable
def _is_stuck(car: CarState) -> bool:
    """Check whether a car is slow, or in reverse, and across the road or beside it."""
    if abs(car.heading_error) < STUCK_ANGLE and abs(track_position(car)) <= 1.0:
        return False
    return car.gear < 0 or hypot(car.speed_x, car.speed_y) < STUCK_SPEED


@register_jitable
def _free(car: CarState) -> tuple[float, float, float, float]:
    """
    Turn a car towards the road, forward while its nose points to the axis and else backward; from
    beside the road drive back to it.

    To turn is the rule of the driver that comes with the Simulated Car Racing championship's
    software (Loiacono, Cardamone and Lanzi, "Simulated Car Racing Championship: Competition
    Software Manual", 2013, arXiv:1304.1672), but slow.

    :param car: that is stuck
    :return: steering, throttle, brake and gear as of :class:`~sb3_torcs.car.Controls`
    """
    if abs(car.heading_error) < STUCK_ANGLE:
        wanted = BACK if track_position(car) > 0.0 else -BACK
        steering = BACK_STEERING * (car.heading_error - wanted)
        return min(max(steering, -1.0), 1.0), CREEP_THROTTLE, 0.0, 1.0
    side = 1.0 if car.heading_error > 0.0 else -1.0
    forward = side * track_position(car) > (OVER_AXIS if car.gear < 0 else -OVER_AXIS)
    way = 1.0 if forward else -1.0
    throttle = brake = 0.0
    if car.speed_x * way < -1.0:
        brake = STOP_BRAKE
    elif car.speed_x * way < CREEP:
        throttle = CREEP_THROTTLE
    return side * way, throttle, brake, way


@register_jitable
def _slides(car: CarState) -> bool:
    """Check whether the tail of a car has come round so far that it will spin."""
    if car.gear < 0 or car.speed_x <= 0.0 or hypot(car.speed_x, car.speed_y) < LEAST_SPEED:
        return False
    return abs(atan2(car.speed_y, car.speed_x)) > SIDESLIP


@njit(cache=True)
def help_cars(episodes: Episodes, rules: Episodes) -> None:
    """
    Change the controls of cars where a driver aid steps in.

    A stuck car frees itself. One that is too close to the car ahead brakes. One that is close to
    cars beside it steers away. One that slides points its front wheels where it goes, and leaves
    the pedals alone: then the tyres have all of their grip to turn it back.

    :param episodes: (n,) of :data:`~sb3_torcs.envs.episode.EPISODE`, whose ``controls`` change
    :param rules: (n,) of :data:`~sb3_torcs.envs.episode.RULES`, with the aids of each car
    """
    for row in range(len(episodes)):
        car, rule, controls = episodes[row].car, rules[row], episodes[row].controls
        if rule.unstick and _is_stuck(car):
            controls.steering, controls.throttle, controls.brake, controls.gear = _free(car)
            controls.clutch = 0.0
            continue
        if rule.keep_distance:
            least = needed_brake(car)
            if least > 0.0:
                controls.throttle, controls.brake = 0.0, max(controls.brake, least)
        if rule.keep_clear:
            steering = controls.steering + needed_turn(car)
            controls.steering = min(max(steering, -1.0), 1.0)
        if rule.catch_slides and _slides(car):
            steering = atan2(car.speed_y, car.speed_x) / STEER_LOCK
            controls.steering = min(max(steering, -1.0), 1.0)
            controls.throttle = controls.brake = 0.0


NEED_RIVALS = ("keep_distance", "keep_clear")
"""Those that have to see other cars."""


def parse_aids(names: str) -> tuple[AidName, ...]:
    """
    Read the names of driver aids.

    :param names: with commas between them, or ``"all"``
    :raises InvalidOption: if there is no aid of such a name
    """
    return (
        AIDS
        if names == "all"
        else checked_aids("aids", [each.strip() for each in names.split(",")])
    )
