"""The conditions of an episode: how late controls arrive, grip and mass."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from sb3_torcs.backends.base import optional
from sb3_torcs.car import FloatArray, checked_delay, checked_factor
from sb3_torcs.envs.arguments import read_group
from sb3_torcs.envs.episode import Episodes
from sb3_torcs.envs.options import CONDITIONS, ConditionOptions
from sb3_torcs.errors import InvalidOption

__all__ = ["Conditions", "hold_controls"]


FACTORS = ("grip", "mass")


@njit(cache=True)
def hold_controls(
    episodes: Episodes, rules: Episodes, held: FloatArray, ticks: npt.NDArray[np.int64]
) -> None:
    """
    Begin a timestep: let controls set out, and find out which of them the cars hold in it.

    Controls that arrive late are those of an earlier timestep. Two are held if the later ones
    arrive within the timestep.

    :param episodes: (n,) of :data:`~sb3_torcs.envs.episode.EPISODE`, whose ``controls`` set out
    :param rules: (n,) of :data:`~sb3_torcs.envs.episode.RULES`
    :param held: (2, n, 5) filled, one set of controls after the other
    :param ticks: (2, n) filled, for how many control ticks each is held; may be 0
    """
    for row in range(len(episodes)):
        episode, controls = episodes[row], episodes[row].controls
        waiting = episode.waiting
        last = int(episode.delay // rules[row].ticks)
        late = episode.delay % rules[row].ticks
        for i in range(waiting.shape[1]):
            held[0, row, i] = waiting[0, i]
        for j in range(last):
            for i in range(waiting.shape[1]):
                waiting[j, i] = waiting[j + 1, i]
        waiting[last, 0] = controls.steering
        waiting[last, 1] = controls.throttle
        waiting[last, 2] = controls.brake
        waiting[last, 3] = controls.gear
        waiting[last, 4] = controls.clutch
        for i in range(waiting.shape[1]):
            held[1, row, i] = waiting[0, i]
        ticks[0, row], ticks[1, row] = int(late), int(rules[row].ticks - late)


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
        self._sets = bool(self._changed)
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
        changed._sets |= self._sets  # a world keeps what it was given last
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

    def draw(self, rng: np.random.Generator, world: Any) -> int:
        """
        Draw the conditions of an episode. Equal bounds draw nothing.

        :param rng: the environment's
        :param world: a backend, in which they are set
        :return: by how many control ticks controls arrive late
        """
        low, high = map(int, self._delays)
        ticks = low if low == high else int(rng.integers(low, high + 1))
        if self._sets:
            self.grip, self.mass = (
                float(low if low == high else rng.uniform(low, high))
                for low, high in self._factors.values()
            )
            world.set_conditions(self.grip, self.mass)
        return ticks
