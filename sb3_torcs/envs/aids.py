"""What a car does by itself, whatever it is asked: driver aids."""

from __future__ import annotations

from dataclasses import dataclass, fields

from sb3_torcs.car import CarState, Controls, checked_flag
from sb3_torcs.envs.slides import caught_steering, slides
from sb3_torcs.envs.unstick import freeing_controls, needs_freeing
from sb3_torcs.errors import InvalidOption, near_miss
from sb3_torcs.rivals import needed_brake, needed_turn

__all__ = ["AIDS", "NEED_RIVALS", "Aids", "aids_named"]


@dataclass
class Aids:
    """
    The driver aids of a car.

    :raises InvalidOption: if one is neither ``True`` nor ``False``
    """

    unstick: bool  # a car that is stuck frees itself
    keep_distance: bool  # it brakes by itself for the car ahead
    keep_clear: bool  # it steers away by itself from those beside it
    catch_slides: bool  # it steers against a slide, before it spins

    def __post_init__(self) -> None:
        for name in AIDS:
            setattr(self, name, checked_flag(name, getattr(self, name)))

    def change(self, controls: Controls, car: CarState) -> Controls:
        """
        Change what a car is asked to do, where an aid steps in.

        :param controls: that were asked for
        :param car: at the begin of a timestep
        """
        if self.unstick and needs_freeing(car):
            return Controls(*freeing_controls(car))
        if self.keep_distance:
            brake = needed_brake(car)
            if brake > 0.0:
                controls = controls._replace(throttle=0.0, brake=max(controls.brake, brake))
        if self.keep_clear:
            steering = min(max(controls.steering + needed_turn(car), -1.0), 1.0)
            controls = controls._replace(steering=steering)
        if self.catch_slides and slides(car):
            controls = controls._replace(steering=caught_steering(car), throttle=0.0, brake=0.0)
        return controls


AIDS = tuple(aid.name for aid in fields(Aids))
"""What they are called as options of an environment, in the order of compiled code."""

NEED_RIVALS = ("keep_distance", "keep_clear")
"""Those that have to see other cars."""


def aids_named(names: str) -> tuple[str, ...]:
    """
    Read the names of driver aids.

    :param names: with commas between them, or ``"all"``
    :return: the names
    :raises InvalidOption: if there is no aid of such a name
    """
    if names == "all":
        return AIDS
    aids = tuple(name.strip() for name in names.split(","))
    for aid in aids:
        if aid not in AIDS:
            advice = f"driver aids: {', '.join(AIDS)}; or 'all' alone"
            raise InvalidOption(f"no driver aid '{aid}'{near_miss(aid, AIDS, advice)}")
    return aids
