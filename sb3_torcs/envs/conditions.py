"""The conditions of an episode: how late controls arrive, grip and mass."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_torcs.car import Controls, is_count, is_number
from sb3_torcs.errors import InvalidOption

__all__ = ["MAX_DELAY", "Conditions", "Delay"]

MAX_DELAY = 50  # control ticks: 1 s
LEAST_FACTOR = 0.5  # of grip or mass; ice is another game
RESTING = Controls(0.0, 0.0, 0.0)  # held until the first action arrives

Part = tuple[Controls, int]
"""Controls, and the control ticks for which they are held."""


class Range(NamedTuple):
    """The bounds of a number that each episode draws; equal ones draw nothing."""

    low: float
    high: float


def checked_range(name: str, choice: Any, low: float, high: float, unit: str) -> Range:
    """
    Check a number, or the two bounds of one that is drawn.

    :param name: of the option
    :param choice: what was given
    :param low: the least that is allowed
    :param high: the most that is allowed
    :param unit: of both, in words
    :raises InvalidOption: if it is no such number
    """
    pair = list(choice) if isinstance(choice, Sequence | np.ndarray) else [choice, choice]
    numbers = not isinstance(choice, str) and len(pair) == 2 and all(map(is_number, pair))
    if not numbers or not low <= pair[0] <= pair[1] <= high:
        raise InvalidOption(
            f"{name} is {choice!r}; expected {unit} from {low:g} to {high:g}, or a pair of them, "
            "between which each episode draws"
        )
    return Range(*pair)


def checked_delay(choice: Any) -> Range:
    """
    Check the option ``delay``.

    :param choice: control ticks, or a pair of them
    :raises InvalidOption: if it is no such number
    """
    bounds = checked_range("delay", choice, 0, MAX_DELAY, "whole control ticks")
    if not all(bound == 0 or is_count(bound) for bound in bounds):
        raise InvalidOption(f"delay is {choice!r}; expected whole control ticks of 0.02 s")
    return bounds


class Delay:
    """
    Controls that arrive late: a timestep goes on with earlier ones until they do.

    :param ticks: from an observation to the arrival of the controls that answer it
    :param repeat: control ticks per timestep
    """

    def __init__(self, ticks: int = 0, repeat: int = 1) -> None:
        self.ticks = ticks
        whole, self._rest = divmod(ticks, repeat)
        self._repeat = repeat
        self.waiting: tuple[Controls, ...] = (RESTING,) * (whole + 1)
        """Controls that are held or on their way, oldest first."""

    def hold(self, controls: Controls) -> list[Part]:
        """
        Begin a timestep.

        :param controls: that set out now
        :return: what is held in it, one part or two
        """
        earlier, later, *_ = *self.waiting, controls
        self.waiting = (*self.waiting[1:], controls)
        parts = [(earlier, self._rest), (later, self._repeat - self._rest)]
        return parts if self._rest else parts[1:]


class Conditions:
    """
    What each episode draws of its world.

    :param delay: control ticks, or a pair of them
    :param grip: factor on the friction of all ground, or a pair
    :param mass: factor on the mass of the car, or a pair
    :raises InvalidOption: if one has a value that is not allowed
    """

    def __init__(self, delay: Any, grip: Any, mass: Any) -> None:
        self._delays = checked_delay(delay)
        self._factors = {
            name: checked_range(name, choice, LEAST_FACTOR, 1.0 / LEAST_FACTOR, "a factor")
            for name, choice in (("grip", grip), ("mass", mass))
        }
        self._changed = [name for name, bounds in self._factors.items() if bounds != (1.0, 1.0)]
        self.grip = self.mass = 1.0

    def check(self, world: Any) -> None:
        """
        Check that a world can change what is to be drawn.

        :param world: a backend
        :raises InvalidOption: if it cannot
        """
        for name in self._changed:
            if name not in getattr(world, "conditions", ()):
                raise InvalidOption(
                    f"{name} is {tuple(self._factors[name])!r}, which this world cannot change; "
                    "leave it out, or use backend 'native' of Torcs-v0, with no agents as opponents"
                )

    def draw(self, rng: np.random.Generator, world: Any, repeat: int) -> Delay:
        """
        Draw the conditions of an episode. Equal bounds draw nothing.

        :param rng: the environment's
        :param world: a backend, which is told
        :param repeat: control ticks per timestep
        :return: the delay
        """
        low, high = map(int, self._delays)
        ticks = low if low == high else int(rng.integers(low, high + 1))
        if self._changed:
            self.grip, self.mass = (
                float(low if low == high else rng.uniform(low, high))
                for low, high in self._factors.values()
            )
            world.set_conditions(self.grip, self.mass)
        return Delay(ticks, repeat)
