"""Several worlds that take turns, one episode each, for agents that learn many tracks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeGuard

import numpy as np

from sb3_torcs.actions import GEARS
from sb3_torcs.backends.base import Backend
from sb3_torcs.car import CarState, Controls, Start
from sb3_torcs.errors import InvalidOption
from sb3_torcs.torcs.car_file import CarFacts
from sb3_torcs.tracks.profile import RoadProfile
from sb3_torcs.tracks.track import Track

__all__ = ["SeveralWorlds", "is_several", "one_or_several", "world_index", "worlds_of"]


def is_several(choice: Any, name: str = "track") -> TypeGuard[Sequence[Any]]:
    """
    Check whether several tracks or cars are given.

    :param choice: what was given
    :param name: of the option
    :raises InvalidOption: if it is an empty list
    """
    several = isinstance(choice, Sequence) and not isinstance(choice, str)
    if several and not choice:
        raise InvalidOption(f"{name} is an empty list; give a name, or a list with one at least")
    return several


def one_or_several(make: Callable[[Any, Any], Backend], track: Any, car: Any) -> Backend:
    """
    Make the world of a track and a car, or one world for each pair if a list is given.

    :param make: makes the world of a track and a car
    :param track: or several
    :param car: or several
    :raises InvalidOption: if a list is empty
    """
    several = is_several(track), is_several(car, "car")
    if not any(several):
        return make(track, car)
    tracks, cars = (track if several[0] else [track]), (car if several[1] else [car])
    return SeveralWorlds(make(one, other) for one in tracks for other in cars)


class SeveralWorlds:
    """
    One of several cars on one of several tracks: each episode draws a pair of them.

    :param worlds: one for each track and car; they have the same range finders
    """

    def __init__(self, worlds: Iterable[Backend]) -> None:
        self.worlds = tuple(worlds)
        self._enter(0)
        self.gears: int = min(getattr(world, "gears", GEARS) for world in self.worlds)
        self.range_finder_angles = self._world.range_finder_angles
        self.tells_race = all(getattr(world, "tells_race", False) for world in self.worlds)
        self.conditions: Sequence[str] = getattr(self._world, "conditions", ())

    @property
    def profile(self) -> RoadProfile | None:
        """The road of the present episode, if it has hills."""
        return getattr(self._world, "profile", None)

    @property
    def facts(self) -> CarFacts | None:
        """What the file of the present episode's car says, if its world knows."""
        return getattr(self._world, "facts", None)

    def _enter(self, index: int) -> None:
        self.index = index
        self._world = self.worlds[index]
        self.track: Track = self._world.track
        self.car = self._world.car

    def draw_track(self, rng: np.random.Generator) -> None:
        """Choose the next episode's world; see :class:`~sb3_torcs.backends.base.Backend`."""
        self._enter(int(rng.integers(len(self.worlds))))

    def set_conditions(self, grip: float, mass: float) -> None:
        """Change the next episode's world; see :class:`~sb3_torcs.backends.base.Backend`."""
        world: Any = self._world
        world.set_conditions(grip, mass)

    def reset(self, rng: np.random.Generator, start: Start | None) -> CarState:
        """Begin an episode; see :class:`~sb3_torcs.backends.base.Backend`."""
        car = self._world.reset(rng, start)
        self.track = self._world.track  # a world may draw a new one by itself
        return car

    def step(self, controls: Controls, ticks: int) -> CarState:
        """Drive on; see :class:`~sb3_torcs.backends.base.Backend`."""
        return self._world.step(controls, ticks)

    def close(self) -> None:
        """Close all worlds."""
        for world in self.worlds:
            world.close()


def worlds_of(backend: Backend) -> tuple[Backend, ...]:
    """
    Return the worlds of a backend.

    :param backend: one world, or several
    """
    worlds: tuple[Backend, ...] = getattr(backend, "worlds", (backend,))
    return worlds


def world_index(backend: Backend) -> int:
    """
    Return the index of the world of the present episode.

    :param backend: one world, or several
    """
    return int(getattr(backend, "index", 0))
