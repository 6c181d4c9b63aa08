"""The interface of a world behind a racing environment.

:class:`~sb3_torcs.envs.racing.RacingEnv` drives any object of this shape. To add a world,
write these three methods and three attributes, and run the contract suite over it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from sb3_torcs.actions import GEARS
from sb3_torcs.car import CarState, Controls, FloatArray, Start
from sb3_torcs.tracks.track import Track

__all__ = ["OPTIONAL", "Backend", "Fleet", "optional"]

OPTIONAL: dict[str, Any] = {
    "gears": GEARS,  # forward ones of the car
    "profile": None,  # the road's :class:`~sb3_torcs.tracks.profile.RoadProfile`, if it has hills
    "facts": None,  # :class:`~sb3_torcs.torcs.car_file.CarFacts` of the present episode's car
    "knows_road": True,  # whether ``track`` is the one that is driven, not a stand-in
    "tells_race": False,  # whether it fills ``CarState.race``
    "shares_race": False,  # whether the cars of other agents move whenever this one does
    "conditions": (),  # of ``grip``, ``mass`` and ``sensor_noise`` those that it can have
    "draw_track": None,  # a method, of a world that has several; see :class:`Backend`
}
"""What a world may have in addition, and what holds for one that does not have it."""


def optional(world: Any, name: str) -> Any:
    """
    Return what a world may have, or what holds for one that does not have it.

    :param world: a backend
    :param name: of :data:`OPTIONAL`
    """
    return getattr(world, name, OPTIONAL[name])


class Backend(Protocol):
    """
    One car in one world.

    A world may have more, :data:`OPTIONAL`. The environment calls ``draw_track(rng)`` of a world
    that has several tracks before it draws a start on one. ``set_conditions(grip, mass)`` sets
    factors that hold from the next reset on.
    """

    @property
    def track(self) -> Track:
        """The track of the present episode."""

    @property
    def car(self) -> str:
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


class Fleet(Protocol):
    """
    Worlds of one kind that are driven at once, one per environment, in the process that made them.

    ``index`` is that of an environment.
    """

    def put(self, index: int, world: Any) -> None:
        """
        Give an environment a world, in which it goes on: another one, or the same.

        :param index: which
        :param world: of the same kind
        """

    def step(
        self,
        indices: npt.NDArray[np.int64],
        controls: FloatArray,
        ticks: npt.NDArray[np.int64],
        cars: FloatArray,
    ) -> list[int]:
        """
        Hold controls in some of the worlds.

        :param indices: (n,) which
        :param controls: (n, 5) as of :class:`~sb3_torcs.car.Controls`, finite and within their
            ranges; a gear of nan leaves it to the gearbox
        :param ticks: (n,) control ticks of 0.02 s
        :param cars: (n, 111) filled, each row a :data:`~sb3_torcs.car.CAR_RECORD`
        :return: the rows that are not filled, of those that failed
        """

    def failure(self, index: int) -> Exception:
        """
        Return what stopped a world.

        :param index: of one that failed in the latest step
        """

    def arrive(self, index: int, steps: Iterable[tuple[Controls, int]], car: CarState) -> None:
        """
        Report to a world which steps it has been driven, before it is used without the fleet.

        :param index: which
        :param steps: controls and ticks since the latest call
        :param car: at their end
        """

    def close(self) -> None:
        """End the threads. The worlds stay."""
