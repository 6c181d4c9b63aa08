"""The gearboxes for those who drive from outside: the rules of the engine, in Python."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from sb3_torcs.actions import SHIFT_DOWN, SHIFT_UP, launch_clutch
from sb3_torcs.car import Controls
from sb3_torcs.errors import CarFileError
from sb3_torcs.scr.protocol import MotorReading

__all__ = ["Gearbox", "read_gearbox"]

GEARS = ("1", "2", "3", "4", "5", "6", "7", "8")  # what the game calls them
LIMITER = 9152.0  # [rpm] of the car that the shift points are given for
RPM = np.float32(0.104719755)  # [rad/s] per rpm, as the game has it
REVS = np.pi / 30.0  # [rad/s] per rpm
METRES = {"in": 0.0254, "inch": 0.0254, "inches": 0.0254, "mm": 0.001, "cm": 0.01}  # others: 1
SHARES = {"%": 0.01}
DIFFERENTIALS = {"FWD": "Front Differential", "4WD": "Central Differential"}
REAR_DIFFERENTIAL = "Rear Differential"


class Gearbox(NamedTuple):
    """When to shift."""

    ratios: tuple[float, ...]  # [-] of the first gear and up
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
            engine_speed = max(speed, 0.0) * self.rolling * ratios[present - 1]
            if present == 1:
                clutch = max(clutch, launch_clutch(engine_speed, self.shift_up))
        return controls._replace(gear=self._choose(gear, engine_speed), clutch=clutch)

    def _choose(self, gear: int, engine_speed: float) -> int:
        """
        Choose the gear.

        :param gear: the present one, -1 reverse, 0 neutral
        :param engine_speed: by which to go [rad/s]
        :return: the gear to ask for
        """
        if gear < 1:
            return 1
        ratios = self.ratios
        if engine_speed > self.shift_up and gear < len(ratios):
            return gear + 1
        if 1 < gear <= len(ratios):
            lower = engine_speed * ratios[gear - 2] / ratios[gear - 1]
            return gear - 1 if lower < self.shift_down else gear
        return gear


def read_gearbox(path: Path, gearbox: str = "automatic") -> Gearbox:
    """
    Read a car's gears, and where its limiter cuts in.

    :param path: of the car's file
    :param gearbox: see :data:`sb3_torcs.actions.GEARBOXES`
    :return: the gearbox; its shift points are those of ``car1-trb1``, as shares of the limiter
    :raises CarFileError: if the file is broken, or the car has no gears
    """
    try:
        car = ElementTree.parse(path).getroot()
        limiter = _limiter(car)
        gears = "section[@name='Gearbox']/section[@name='gears']"
        ratios = [_number(car, f"{gears}/section[@name='{gear}']", "ratio", 0.0) for gear in GEARS]
        rolling = _rolling(car, path) if gearbox == "road_speed" else None
    except (ElementTree.ParseError, ValueError) as error:
        raise CarFileError(f"{path} is broken ({error}); type: `sb3-torcs install-torcs`") from None
    number = max((place for place, ratio in enumerate(ratios, 1) if ratio > 0.0), default=0)
    if number == 0 or limiter <= 0.0:
        raise CarFileError(f"{path} has no gears or no rev limiter; choose another car")
    # The arithmetic of the engine, which is in single precision.
    up = np.float32(SHIFT_UP / REVS) / np.float32(LIMITER) * limiter
    down = np.float32(SHIFT_DOWN / REVS) / np.float32(LIMITER) * limiter
    return Gearbox(tuple(ratios[:number]), float(up), float(down), rolling)


def _limiter(car: ElementTree.Element) -> np.float32:
    """
    Read at which motor speed the limiter cuts in.

    :param car: the file
    :return: [rad/s]; 0 if it does not say
    """
    entry = car.find("section[@name='Engine']/attnum[@name='revs limiter']")
    if entry is None:
        return np.float32(0.0)
    return np.float32(entry.get("val", "")) * (RPM if entry.get("unit") == "rpm" else np.float32(1))


def _rolling(car: ElementTree.Element, path: Path) -> float:
    """
    Work out how far a motor turns on the way, by a gear of ratio 1: as the game does.

    :param car: the file
    :param path: where it is; its category is beside the cars
    :return: [rad/m]
    """
    drivetrain = "section[@name='Drivetrain']/attstr[@name='type']"
    category = car.find("section[@name='Car']/attstr[@name='category']")
    kind = car.find(drivetrain)
    if kind is None and category is not None:
        file = path.parents[2] / "categories" / f"{category.get('val')}.xml"
        kind = ElementTree.parse(file).getroot().find(drivetrain) if file.is_file() else None
    driven = "RWD" if kind is None else kind.get("val", "")
    final = f"section[@name='{DIFFERENTIALS.get(driven, REAR_DIFFERENTIAL)}']"
    wheel = "section[@name='Rear Right Wheel']"
    width = _number(car, wheel, "tire width", 0.145, METRES)
    height = width * _number(car, wheel, "tire height-width ratio", 0.75, SHARES)
    radius = 0.5 * _number(car, wheel, "rim diameter", 0.33, METRES) + height
    if radius <= 0.0:
        raise ValueError(f"the rear wheels have a radius of {radius:g} m")
    return _number(car, final, "ratio", 1.0) / radius


def _number(
    car: ElementTree.Element,
    section: str,
    name: str,
    fallback: float,
    units: dict[str, float] | None = None,
) -> float:
    """
    Read a number.

    :param car: the file
    :param section: where it stands
    :param name: what it is called
    :param fallback: if it is not there
    :param units: their factors; 1 for those that are not named
    """
    entry = car.find(f"{section}/attnum[@name='{name}']")
    if entry is None:
        return fallback
    return float(entry.get("val", "")) * (units or {}).get(entry.get("unit", ""), 1.0)
