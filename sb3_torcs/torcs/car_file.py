"""What a car's file says of how it drives: tyres, air, motor, mass and steering.

The game merges a car's file with that of its category: what the car leaves out is the category's,
and what that leaves out has a value of its own, in the game's ``simuv2`` (TORCS 1.3.7).
"""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from sb3_torcs import maths
from sb3_torcs.errors import CarFileError
from sb3_torcs.torcs.nodes import Node

__all__ = ["CarFacts", "car_facts"]

WHEELS = ("Front Right Wheel", "Front Left Wheel", "Rear Right Wheel", "Rear Left Wheel")
FUEL_DENSITY = 1.0  # [kg/l] in the game


class CarFacts(NamedTuple):
    """
    A car as it leaves the pits: undamaged, with its file's setup and its initial fuel.

    Air resistance and downforce have the rear wing in them and not the front one, as the game's
    robots and its slipstream reckon.
    """

    grip: float  # [-] least factor of its tyres on the friction of the ground
    downforce: float  # [1/m] per speed squared and mass
    power: float  # [W/kg] greatest of the motor, per mass
    drag: float  # [1/m] air resistance per speed squared and mass
    mass: float  # [kg] with the initial fuel
    steer: float  # [rad] greatest angle of the front wheels, to either side


class _Merged:
    """
    A car's file, with what its category's adds.

    :param path: of the car's file; its category is beside the cars
    """

    def __init__(self, path: Path) -> None:
        car = Node.read(path)
        category = car.child("Car").text("category")
        limits = path.parents[2] / "categories" / f"{category}.xml"
        self._files = (car, Node.read(limits)) if category else (car,)

    def has(self, *section: str) -> bool:
        """Whether one of the files has a section, whose name is given from the outside in."""
        return any(file.child(*section).name for file in self._files)

    def number(self, *section: str, name: str, default: float) -> float:
        """
        Read a number in SI units.

        :param section: its name, from the outside in
        :param name: of the number
        :param default: what the game takes if no file has it
        """
        car, *category = (file.child(*section) for file in self._files)
        for limits in category:
            default = limits.number(name, default)
        default = car.number(name, default)
        # The game takes no more than the category allows, but less than its least.
        for limits in category:
            default = min(default, limits.largest(name))
        if not math.isfinite(default):
            raise ValueError(f"{name} is {default}")
        return default


@lru_cache
def car_facts(path: Path) -> CarFacts:
    """
    Read what distinguishes a car from others.

    :param path: of the car's file, inside the game's folder of data
    :return: its facts
    :raises CarFileError: if the file or that of its category is broken
    """
    try:
        car = _Merged(path)
        mass = _mass(car)
        if mass <= 0.0:
            raise ValueError(f"the mass is {mass:g} kg")
        wing = 1.23 * car.number("Rear Wing", name="area", default=0.0)
        wing *= maths.sin(car.number("Rear Wing", name="angle", default=0.0))
        return CarFacts(
            grip=min(car.number(wheel, name="mu", default=1.0) for wheel in WHEELS),
            downforce=(_ground_effect(car) + 4.0 * wing) / mass,
            power=_power(car) / mass,
            drag=(_body_drag(car) + wing) / mass,
            mass=mass,
            steer=car.number("Steer", name="steer lock", default=0.43),
        )
    except (ValueError, OverflowError, OSError) as error:
        raise CarFileError(f"{path} is broken ({error}); type: `sb3-torcs install-torcs`") from None


def _mass(car: _Merged) -> float:
    """Return the mass with the initial fuel [kg]."""
    tank = car.number("Car", name="fuel tank", default=80.0)
    fuel = car.number("Car", name="initial fuel", default=80.0)
    return car.number("Car", name="mass", default=1500.0) + FUEL_DENSITY * min(fuel, tank)


def _ground_effect(car: _Merged) -> float:
    """Return the downforce of the body per speed squared [kg/m], of a car at rest."""
    heights = [car.number(wheel, name="ride height", default=0.2) for wheel in WHEELS]
    lift = [car.number("Aerodynamics", name=f"{end} Clift", default=0.0)
            for end in ("front", "rear")]  # fmt: skip
    height = 1.5 * math.fsum(heights)
    square = height * height
    return 2.0 * maths.exp(-3.0 * square * square) * math.fsum(lift)


def _body_drag(car: _Merged) -> float:
    """Return the air resistance without wings per speed squared [kg/m]."""
    area = car.number("Aerodynamics", name="front area", default=2.5)
    return 0.645 * car.number("Aerodynamics", name="Cx", default=0.4) * area


def _power(car: _Merged) -> float:
    """
    Return the greatest power of the motor [W].

    As the game reckons it: at the points of the torque's curve but the first, between idling and
    the limiter.
    """
    idling = car.number("Engine", name="tickover", default=150.0)
    limiter = car.number("Engine", name="revs limiter", default=800.0)
    most = car.number("Engine", name="revs maxi", default=1000.0)
    greatest, point = 0.0, 2
    while car.has("Engine", "data points", str(point)):
        speed = car.number("Engine", "data points", str(point), name="rpm", default=most)
        torque = car.number("Engine", "data points", str(point), name="Tq", default=0.0)
        if idling <= speed < limiter:
            greatest = max(greatest, speed * torque)
        point += 1
    return greatest
