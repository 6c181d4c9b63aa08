"""The conditions of an episode: how late controls arrive, grip and mass."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sb3_torcs.backends.base import optional
from sb3_torcs.car import RESTING, Controls, checked_delay, checked_factor
from sb3_torcs.envs.arguments import read_group
from sb3_torcs.envs.options import CONDITIONS, ConditionOptions
from sb3_torcs.errors import InvalidOption

__all__ = ["Conditions", "Delay", "Part"]

Part = tuple[Controls, int]
"""Controls, and the control ticks for which they are held."""


FACTORS = ("grip", "mass")


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

    :param choice: what was chosen, by name
    :raises InvalidOption: if a name or a value is not allowed
    """

    def __init__(self, choice: ConditionOptions | Mapping[str, Any] | None = None) -> None:
        self.choice = read_group("conditions", CONDITIONS, choice)
        self._delays = checked_delay(self.choice["delay"])
        self._factors = {name: checked_factor(name, self.choice[name]) for name in FACTORS}
        self._changed = [name for name, bounds in self._factors.items() if bounds != (1.0, 1.0)]
        self._tells = bool(self._changed)
        self.grip = self.mass = 1.0

    def instead(self, choice: Mapping[str, Any]) -> Conditions:
        """
        Make conditions instead of these.

        :param choice: those that change, by name
        :raises InvalidOption: if a name or a value is not allowed
        """
        changed = Conditions({**self.choice, **choice})
        noise = self.choice["sensor_noise"]
        if changed.choice["sensor_noise"] != noise:
            raise InvalidOption(
                f"sensor_noise was {noise} when the environment was made, and stays so; make "
                "another one"
            )
        changed._tells |= self._tells  # a world keeps what it was told last
        changed.grip, changed.mass = self.grip, self.mass  # of the present episode
        return changed

    def check(self, world: Any) -> None:
        """
        Check that a world can change what is to be drawn.

        :param world: a backend
        :raises InvalidOption: if it cannot
        """
        if self._delays != (0.0, 0.0) and optional(world, "shares_race"):
            raise InvalidOption(
                f"delay is {self.choice['delay']!r}, and the cars of one race move at once; leave "
                "it out, or drive each agent in a race of its own"
            )
        noise = ["sensor_noise"] if self.choice["sensor_noise"] else []
        for name in self._changed + noise:
            if name not in optional(world, "conditions"):
                raise InvalidOption(
                    f"{name} is {self.choice[name]!r}, which this world cannot change; "
                    "leave it out, or use backend 'native' of Torcs-v0, with no agents as opponents"
                )

    def draw(self, rng: np.random.Generator, world: Any, repeat: int) -> Delay:
        """
        Draw the conditions of an episode. Equal bounds draw nothing.

        :param rng: the environment's
        :param world: a backend, in which they are set
        :param repeat: control ticks per timestep
        :return: the delay
        """
        low, high = map(int, self._delays)
        ticks = low if low == high else int(rng.integers(low, high + 1))
        if self._tells:
            self.grip, self.mass = (
                float(low if low == high else rng.uniform(low, high))
                for low, high in self._factors.values()
            )
            world.set_conditions(self.grip, self.mass)
        return Delay(ticks, repeat)
