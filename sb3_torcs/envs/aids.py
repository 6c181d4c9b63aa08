"""What a car does by itself, whatever it is asked: driver aids."""

from __future__ import annotations

from typing import Any

from sb3_torcs.car import CarState, Controls, checked_flag
from sb3_torcs.envs.unstick import freeing_controls, needs_freeing
from sb3_torcs.rivals import needed_brake, needed_turn

__all__ = ["Aids"]


class Aids:
    """
    The driver aids of a car.

    :param unstick: whether a car that is stuck frees itself
    :param keep_distance: whether a car brakes by itself for the one ahead
    :param keep_clear: whether a car steers away by itself from those beside it
    :raises InvalidOption: if one is neither ``True`` nor ``False``
    """

    def __init__(self, unstick: Any, keep_distance: Any, keep_clear: Any) -> None:
        self.unstick = checked_flag("unstick", unstick)
        self.keep_distance = checked_flag("keep_distance", keep_distance)
        self.keep_clear = checked_flag("keep_clear", keep_clear)

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
        return controls
