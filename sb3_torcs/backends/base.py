"""The interface of a world behind a racing environment.

:class:`~sb3_torcs.envs.racing.RacingEnv` drives any object of this shape. To add a world,
write these three methods and three attributes, and run the contract suite over it.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from sb3_torcs.car import CarState, Controls, FloatArray, Start
from sb3_torcs.tracks.track import Track

__all__ = ["Backend"]


class Backend(Protocol):
    """
    One car in one world.

    A world that has several tracks has a method ``draw_track(rng)``, which the environment calls
    before it draws a start on that track. One whose car has more or fewer than six forward gears
    has an attribute ``gears``.
    """

    track: Track
    """The track of the present episode."""

    car: str
    """Name of the car, e.g. ``"car1-trb1"``."""

    range_finder_angles: FloatArray
    """(19,) [rad] of the range finders against the car's axis, left negative as in SCR."""

    def reset(self, rng: np.random.Generator, start: Start | None) -> CarState:
        """
        Begin an episode. Called by ``RacingEnv.reset``.

        :param rng: the environment's generator, the only one that may be used
        :param start: where to begin; ``None`` is the grid, standing
        :return: the car before the first timestep
        """

    def step(self, controls: Controls, ticks: int) -> CarState:
        """
        Hold the controls for some control ticks. Called by ``RacingEnv.step``.

        :param controls: finite and within their ranges
        :param ticks: control ticks of 0.02 s, at least 1
        :return: the car after the last tick
        :raises CarLost: if this race cannot go on; a reset begins another
        """

    def close(self) -> None:
        """Free all resources. Called once by ``RacingEnv.close``."""
