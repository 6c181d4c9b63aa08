"""The gearboxes of clients: the same rules as in the engine, in Python."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_torcs.actions import SHIFT_DOWN_RPM, SHIFT_UP_RPM, automatic_gear, launch_clutch
from sb3_torcs.car import LIMITER_RPM, Controls, FloatArray
from sb3_torcs.errors import CarFileError
from sb3_torcs.scr.protocol import MotorReading
from sb3_torcs.torcs.nodes import Node

__all__ = ["Gearbox", "read_gearbox"]

GEARS = ("1", "2", "3", "4", "5", "6", "7", "8")  # the game's names
DIFFERENTIALS = {"FWD": "Front Differential", "4WD": "Central Differential"}
REAR_DIFFERENTIAL = "Rear Differential"


class Gearbox(NamedTuple):
    """The gears of a car, and when to shift."""

    ratios: FloatArray  # (gears,) [-] of the first gear and up
    shift_up: float  # [rad/s] above which
    shift_down: float  # [rad/s] below which the lower gear would turn the motor
    rolling: float | None = None  # [rad/m] that the motor turns on the way, by a ratio of 1;
    # None goes by the motor's own speed

    def shift(self, controls: Controls, reading: MotorReading) -> Controls:
        """
        Choose gear and clutch; forward gears only.

        :param controls: what else is asked for
        :param reading: of the car
        :return: the controls, with a gear
        """
        _, gear, engine_speed, speed = reading
        clutch = controls.clutch
        ratios = self.ratios
        present = min(max(gear, 1), len(ratios))
        if self.rolling is not None:
            engine_speed = max(speed, 0.0) * self.rolling * float(ratios[present - 1])
            if present == 1:
                clutch = max(clutch, launch_clutch(engine_speed, self.shift_up))
        wanted = automatic_gear(gear, engine_speed, ratios, self.shift_up, self.shift_down)
        return controls._replace(gear=wanted, clutch=clutch)


def read_gearbox(path: Path, gearbox: str = "automatic") -> Gearbox:
    """
    Read a car's gears, and where its limiter cuts in.

    :param path: of the car's file
    :param gearbox: see :data:`sb3_torcs.actions.GEARBOXES`
    :return: the gearbox; its shift points are those of ``car1-trb1``, as shares of the limiter
    :raises CarFileError: if the file is broken, or the car has no gears
    """
    try:
        car = Node.read(path)
        limiter = car.child("Engine").number("revs limiter", real=np.float32)
        gears = car.child("Gearbox", "gears")
        ratios = [gears.child(gear).number("ratio") for gear in GEARS]
        rolling = _rolling(car, path) if gearbox == "road_speed" else None
    except ValueError as error:
        raise CarFileError(f"{path} is broken ({error}); type: `sb3-torcs install-torcs`") from None
    number = max((place for place, ratio in enumerate(ratios, 1) if ratio > 0.0), default=0)
    if number == 0 or limiter <= 0.0:
        raise CarFileError(f"{path} has no gears or no rev limiter; choose another car")
    # The arithmetic of the engine, which is in single precision.
    up, down = (
        float(np.float32(revs) / np.float32(LIMITER_RPM) * np.float32(limiter))
        for revs in (SHIFT_UP_RPM, SHIFT_DOWN_RPM)
    )
    return Gearbox(np.array(ratios[:number]), up, down, rolling)


def _rolling(car: Node, path: Path) -> float:
    """
    Compute the motor's angle per metre in a gear of ratio 1, as the game does.

    :param car: the file
    :param path: where it is; its category is beside the cars
    :return: [rad/m]
    """
    driven = car.child("Drivetrain").text("type")
    category = car.child("Car").text("category")
    file = path.parents[2] / "categories" / f"{category}.xml"
    if not driven and category and file.is_file():
        driven = Node.read(file).child("Drivetrain").text("type")
    wheel = car.child("Rear Right Wheel")
    height = wheel.number("tire width", 0.145) * wheel.number("tire height-width ratio", 0.75)
    radius = 0.5 * wheel.number("rim diameter", 0.33) + height
    if radius <= 0.0:
        raise ValueError(f"the rear wheels have a radius of {radius:g} m")
    final = car.child(DIFFERENTIALS.get(driven, REAR_DIFFERENTIAL))
    return final.number("ratio", 1.0) / radius
