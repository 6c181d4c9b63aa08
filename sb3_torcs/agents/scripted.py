"""A driver without a network, as a yardstick for trained agents."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from sb3_torcs.car import RANGE_FINDERS
from sb3_torcs.errors import InvalidOption
from sb3_torcs.sensors import SENSORS, choices_of_size, feature_slices

__all__ = ["SCRIPTED", "ScriptedDriver"]

SCRIPTED = "scripted"
"""What the driver is called wherever a driver is named."""

LAYOUTS = ("pedals", "pedal")  # of the actions that it can give

_SCALE = {sensor.name: sensor.scale for sensor in SENSORS}
_WHERE = feature_slices()

STEERING_GAIN = 2.5  # [1/rad] steering per angle to where the road is longest
CALM_SPEED = 20.0  # [m/s] above which the car turns so readily that the driver steers less
CENTRING = 0.12  # [-] steering per track position
LOOK = 3  # range finders on each side of the longest that also count
AHEAD = slice(7, 12)  # range finders within 20 degrees of straight on
BRAKING = 7.0  # [m/s²] what the driver trusts the brakes with; loose ground gives no more
CORNER_SPEED = 9.0  # [m/s] through a bend of which nothing is seen ahead
MARGIN = 10.0  # [m] of the view not to count on; a hairpin's outer edge is seen 11 m ahead
PEDAL_GAIN = 0.35  # [s/m] pedal per difference of speed
MAX_BRAKE = 0.3  # [-] more locks the rear wheels
SLIP_LIMIT = 2.0  # [m/s] of wheel slip before the driver lifts; twice that cuts the throttle
SLIDE_LIMIT = 0.1  # [-] sideways per forward speed before the driver lifts
SLIDE_GAIN = 3.0  # [-] throttle given up per slide beyond that
BEND_GRIP = 10.0  # [m/s²] a car that turns faster than this allows is swinging, not cornering
SWING_TIME = 0.2  # [s] by which the driver steers ahead of a swing
TYRE_RADIUS = 0.33  # [m]
AXLE_WIDTH = 1.6  # [m] between the front wheels


class ScriptedDriver:
    """
    Drives by the range finders: towards the longest beam, as fast as it can still stop.

    It does not know the grip. It lifts the throttle when wheels spin or the car slides, and steers
    against a swinging tail, so the same driver laps asphalt and dirt. It has the signature
    of a model, ``predict(observation) -> (action, state)``, and needs the ``"scr"`` range finders.

    :param action: layout of its actions, ``"pedals"`` or ``"pedal"``
    :raises InvalidOption: for another layout
    """

    def __init__(self, action: str = "pedals") -> None:
        if action not in LAYOUTS:
            raise InvalidOption(
                f"the scripted driver has no action {action!r}; expected "
                f"{' or '.join(map(repr, LAYOUTS))}, with a gearbox that shifts by itself"
            )
        self._signed = action == "pedal"
        self._angles = np.radians(RANGE_FINDERS["scr"])

    def predict(
        self,
        observation: npt.NDArray[np.float32],
        state: None = None,
        episode_start: npt.NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[npt.NDArray[np.float32], None]:
        """
        Decide.

        :param observation: (29,) or (n, 29), or with more groups of sensors, which it ignores
        :param state: unused; the driver has no state
        :param episode_start: unused
        :param deterministic: unused; it always is
        :return: the action or actions, and no state
        """
        del state, episode_start, deterministic
        rows = np.asarray(observation, dtype=np.float64)
        if rows.ndim not in (1, 2) or not choices_of_size(rows.shape[-1]):
            raise InvalidOption(f"observation has shape {rows.shape}; expected (29,) or (n, 29)")
        if rows.ndim == 1:
            return self._drive(rows), None
        return np.stack([self._drive(row) for row in rows]), None

    def _drive(self, observation: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
        """Choose the action of one observation, (29,)."""

        def read(name: str) -> npt.NDArray[np.float64]:
            return observation[_WHERE[name]] / _SCALE[name]

        beams = read("range_finders")
        position = float(read("track_position")[0])
        if beams[0] < 0.0:  # off the road: back to it, gently
            back = 2.0 * float(read("heading_error")[0]) - 0.5 * position
            return self._action(back, 0.2)
        speed, sideways = float(read("speed_x")[0]), float(read("speed_y")[0])
        wheels = read("wheel_speeds") * TYRE_RADIUS  # [m/s] of the tyres' treads
        steering = STEERING_GAIN * (self._aim(beams) - SWING_TIME * _swing(wheels, speed))
        steering *= min(CALM_SPEED / max(speed, 1.0), 1.0)
        steering -= CENTRING * position
        pedal = _pedal(float(beams[AHEAD].max()), speed, sideways, wheels)
        return self._action(steering, pedal)

    def _action(self, steering: float, pedal: float) -> npt.NDArray[np.float32]:
        """Lay the action out, with a throttle [0, 1] or, negative, brake."""
        if self._signed:
            return np.clip(np.array([steering, pedal], np.float32), -1.0, 1.0)
        action = np.array([steering, max(pedal, 0.0), max(-pedal, 0.0)], np.float32)
        return np.clip(action, [-1.0, 0.0, 0.0], [1.0, 1.0, 1.0]).astype(np.float32)

    def _aim(self, beams: npt.NDArray[np.float64]) -> float:
        """Where the road is longest [rad], left positive; the beams around the longest count."""
        longest = int(np.argmax(beams))
        near = slice(max(longest - LOOK, 0), longest + LOOK + 1)
        weights = beams[near] ** 2
        # Summed exactly: a dot product is rounded otherwise on other processors.
        return -math.fsum(weights * self._angles[near]) / math.fsum(weights)


def _swing(wheels: npt.NDArray[np.float64], speed: float) -> float:
    """How much faster the car turns than a bend can ask for [rad/s]: the front wheels tell."""
    turning = float(wheels[0] - wheels[1]) / AXLE_WIDTH
    bend = BEND_GRIP / max(speed, 1.0)
    return turning - min(max(turning, -bend), bend)


def _pedal(view: float, speed: float, sideways: float, wheels: npt.NDArray[np.float64]) -> float:
    """Throttle [0, 1] or, negative, brake: to the speed that can still be lost within the view."""
    target = math.sqrt(CORNER_SPEED**2 + 2.0 * BRAKING * max(view - MARGIN, 0.0))
    pedal = min(max(PEDAL_GAIN * (target - speed), -MAX_BRAKE), 1.0)
    if pedal <= 0.0:
        locked = speed - float(wheels.mean()) > SLIP_LIMIT
        return 0.0 if locked else pedal
    spin = float(wheels[2:].mean()) - speed
    slide = abs(sideways) / max(speed, 5.0)
    traction = min(max(2.0 - spin / SLIP_LIMIT, 0.0), 1.0)
    return pedal * traction * min(max(1.0 - SLIDE_GAIN * (slide - SLIDE_LIMIT), 0.0), 1.0)
