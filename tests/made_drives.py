"""Drives that are made up: a car at a speed that is given by its place on the oval."""

from __future__ import annotations

import numpy as np
from conftest import car_state

from sb3_torcs.car import CONTROL_TICK, Controls
from sb3_torcs.telemetry import DriveLabel, DriveLog


def drive(log, road, driver="ana", *, speed=lambda place: 20.0, laps=2, brake=lambda place: 0.0,
          end=0.0, **label):  # fmt: skip
    """
    Drive flying laps behind a lap from the grid, which here begins at the line.

    :param speed: [m/s] by the place [m]
    :param brake: [-] by the place [m]
    :param end: [m] of a last lap that is not driven to its end
    """
    label = DriveLabel(driver, "oval", "car1-trb1", "TorcsLite-v0")._replace(**label)
    raced, time, lap_begin, last, done = 0.0, 0.0, 0.0, 0.0, 0
    while raced < laps * road.length + end:
        place = raced % road.length
        now = speed(place)
        raced, time = raced + now * CONTROL_TICK, time + CONTROL_TICK
        if raced // road.length > done:
            # Exactly at the line, as the game does.
            over = raced % road.length / now
            last, lap_begin, done = time - over - lap_begin, time - over, done + 1
        car = car_state(
            time=time, speed_x=now if time > CONTROL_TICK else 0.0,
            distance_from_start=raced % road.length, distance_raced=raced,
            laps=done, lap_time=time - lap_begin, last_lap_time=last,
            wheel_speeds=np.full(4, now / 0.3),
        )  # fmt: skip
        log.add(label, car, Controls(0.0, 0.5, brake(place)))
    return log


def log_of(road, *drivers):
    """A log of several drivers, each ``(name, speed)`` in m/s."""
    log = DriveLog()
    for name, pace in drivers:
        drive(log, road, name, speed=lambda place, pace=pace: pace)
    return log
