"""What a car does by itself, whatever it is asked: driver aids."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from sb3_torcs.car import CarState, Controls
from sb3_torcs.envs.options import AIDS, AidName, checked_aids
from sb3_torcs.envs.slides import caught_steering, slides
from sb3_torcs.envs.unstick import freeing_controls, needs_freeing
from sb3_torcs.rivals import needed_brake, needed_turn

__all__ = ["NEED_RIVALS", "Aids", "aided", "aids_named"]


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

    def change(self, controls: Controls, car: CarState) -> Controls:
        """
        Change what a car is asked to do, where an aid steps in.

        :param controls: that were asked for
        :param car: at the beginning of a timestep
        """
        if self.unstick and needs_freeing(car):
            return Controls(*freeing_controls(car))
        steering, throttle, brake = aided(
            car, controls[:3], self.keep_distance, self.keep_clear, self.catch_slides
        )
        return controls._replace(steering=steering, throttle=throttle, brake=brake)


def aided(
    car: CarState,
    asked: tuple[float, float, float],
    keep_distance: bool,
    keep_clear: bool,
    catch_slides: bool,
) -> tuple[float, float, float]:
    """
    Change steering, throttle and brake where an aid steps in. Compiled code calls it, too.

    :param car: at the beginning of a timestep
    :param asked: steering, throttle and brake
    :param keep_distance: as of :class:`Aids`, and so on
    :return: the same three
    """
    steering, throttle, brake = asked
    if keep_distance:
        least = needed_brake(car)
        if least > 0.0:
            throttle, brake = 0.0, max(brake, least)
    if keep_clear:
        steering = min(max(steering + needed_turn(car), -1.0), 1.0)
    if catch_slides and slides(car):
        steering, throttle, brake = caught_steering(car), 0.0, 0.0
    return steering, throttle, brake


NEED_RIVALS = ("keep_distance", "keep_clear")
"""Those that have to see other cars."""


def aids_named(names: str) -> tuple[AidName, ...]:
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
