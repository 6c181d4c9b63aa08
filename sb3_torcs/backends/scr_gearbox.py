"""The automatic gearbox for those who drive from outside: the rule of the engine, in Python."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from sb3_torcs.actions import SHIFT_DOWN, SHIFT_UP
from sb3_torcs.errors import CarFileError

__all__ = ["Gearbox", "read_gearbox"]

GEARS = ("1", "2", "3", "4", "5", "6", "7", "8")  # what the game calls them
LIMITER = 9152.0  # [rpm] of the car that the shift points are given for
RPM = np.float32(0.104719755)  # [rad/s] per rpm, as the game has it
REVS = np.pi / 30.0  # [rad/s] per rpm


class Gearbox(NamedTuple):
    """When to shift."""

    ratios: tuple[float, ...]  # [-] of the first gear and up
    shift_up: float  # [rad/s] above which
    shift_down: float  # [rad/s] below which the lower gear would turn the engine

    def choose(self, gear: int, engine_speed: float) -> int:
        """
        Choose the gear to ask for; forward gears only.

        :param gear: the present one, -1 reverse, 0 neutral
        :param engine_speed: [rad/s]
        :return: the gear
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


def read_gearbox(path: Path) -> Gearbox:
    """
    Read a car's gears, and where its limiter cuts in.

    :param path: of the car's file
    :return: the gearbox; its shift points are those of ``car1-trb1``, as shares of the limiter
    :raises CarFileError: if the file is broken, or the car has no gears
    """
    try:
        car = ElementTree.parse(path).getroot()
        limiter = _limiter(car)
        section = car.find("section[@name='Gearbox']/section[@name='gears']")
        ratios = [0.0 if section is None else _ratio(section, gear) for gear in GEARS]
    except (ElementTree.ParseError, ValueError) as error:
        raise CarFileError(f"{path} is broken ({error}); type: `sb3-torcs install-torcs`") from None
    number = max((place for place, ratio in enumerate(ratios, 1) if ratio > 0.0), default=0)
    if number == 0 or limiter <= 0.0:
        raise CarFileError(f"{path} has no gears or no rev limiter; choose another car")
    # The arithmetic of the engine, which is in single precision.
    up = np.float32(SHIFT_UP / REVS) / np.float32(LIMITER) * limiter
    down = np.float32(SHIFT_DOWN / REVS) / np.float32(LIMITER) * limiter
    return Gearbox(tuple(ratios[:number]), float(up), float(down))


def _limiter(car: ElementTree.Element) -> np.float32:
    """
    Read at which engine speed the limiter cuts in.

    :param car: the file
    :return: [rad/s]; 0 if it does not say
    """
    entry = car.find("section[@name='Engine']/attnum[@name='revs limiter']")
    if entry is None:
        return np.float32(0.0)
    return np.float32(entry.get("val", "")) * (RPM if entry.get("unit") == "rpm" else np.float32(1))


def _ratio(gears: ElementTree.Element, gear: str) -> float:
    """
    Read the ratio of a gear.

    :param gears: the section of all
    :param gear: its name
    :return: 0 if there is none
    """
    entry = gears.find(f"section[@name='{gear}']/attnum[@name='ratio']")
    return 0.0 if entry is None else float(entry.get("val", ""))
