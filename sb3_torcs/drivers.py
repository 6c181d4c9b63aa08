"""A driver without a network: the yardstick that a learned one has to beat."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from sb3_torcs.errors import InvalidOption
from sb3_torcs.sensors import OBSERVATION_SIZE, RANGE_FINDERS, SENSORS, feature_slices

__all__ = ["ScriptedDriver"]

_SCALE = {sensor.name: sensor.scale for sensor in SENSORS}
_WHERE = feature_slices()

STEERING_GAIN = 2.5  # [1/rad] steering per angle to where the road is longest
CENTRING = 0.12  # [-] steering per track position
LOOK = 3  # range finders on each side of the longest that also count
BRAKING = 5.0  # [m/s²] what the driver trusts the brakes with
CORNER_SPEED = 9.0  # [m/s] through a bend of which nothing is seen ahead
TOP_SPEED = 70.0  # [m/s]
PEDAL_GAIN = 0.35  # [s/m] pedal per difference of speed
MAX_BRAKE = 0.3  # [-] more locks the rear wheels
SLIP_LIMIT = 2.0  # [m/s] of wheel slip before the driver lifts


class ScriptedDriver:
    """
    Drives by the range finders: towards the longest beam, as fast as it can still stop.

    It has the signature of a model, ``predict(observation) -> (action, state)``, and needs the
    ``"scr"`` range finders.
    """

    def __init__(self) -> None:
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

        :param observation: (29,) or (n, 29)
        :param state: unused; the driver remembers nothing
        :param episode_start: unused
        :param deterministic: unused; it always is
        :return: the action, (3,) or (n, 3), and no state
        """
        del state, episode_start, deterministic
        rows = np.asarray(observation, dtype=np.float64)
        if rows.shape[-1] != OBSERVATION_SIZE or rows.ndim > 2:
            raise InvalidOption(f"observation has shape {rows.shape}; expected (29,) or (n, 29)")
        if rows.ndim == 1:
            return self._drive(rows), None
        return np.stack([self._drive(row) for row in rows]), None

    def _drive(self, observation: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
        def read(name: str) -> npt.NDArray[np.float64]:
            return observation[_WHERE[name]] / _SCALE[name]

        beams = read("range_finders")
        speed = float(read("speed_x")[0])
        heading_error = float(read("heading_error")[0])
        position = float(read("track_position")[0])
        if beams[0] < 0.0:  # off the road: back to it, gently
            return np.array([2.0 * heading_error - 0.5 * position, 0.2, 0.0], np.float32)
        longest = int(np.argmax(beams))
        near = slice(max(longest - LOOK, 0), longest + LOOK + 1)
        weights = beams[near] ** 2
        aim = -float(weights @ self._angles[near] / weights.sum())
        steering = STEERING_GAIN * aim - CENTRING * position
        view = float(beams[7:12].max())
        target = min(math.sqrt(CORNER_SPEED**2 + 2.0 * BRAKING * view), TOP_SPEED)
        pedal = PEDAL_GAIN * (target - speed)
        wheels = read("wheel_speeds") * 0.33  # [m/s] of the tyres' treads
        if pedal > 0.0 and float(wheels[2:].mean()) - speed > SLIP_LIMIT:
            pedal *= 0.3
        if pedal < 0.0 and speed - float(wheels.mean()) > SLIP_LIMIT:
            pedal = 0.0
        action = np.array([steering, max(pedal, 0.0), min(max(-pedal, 0.0), MAX_BRAKE)], np.float32)
        return np.clip(action, [-1.0, 0.0, 0.0], [1.0, 1.0, 1.0]).astype(np.float32)
