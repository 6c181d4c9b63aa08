"""Several worlds that take turns, one episode each, for agents that learn many tracks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, TypeGuard

import numpy as np

from sb3_torcs.actions import GEARS
from sb3_torcs.backends.base import Backend
from sb3_torcs.car import CarState, Controls, Start
from sb3_torcs.errors import InvalidOption
from sb3_torcs.tracks.track import Track

__all__ = ["SeveralTracks", "is_several"]


def is_several(track: Any) -> TypeGuard[Sequence[Any]]:
    """
    Check whether several tracks are given.

    :param track: what was given
    :raises InvalidOption: if it is an empty list
    """
    several = isinstance(track, Sequence) and not isinstance(track, str)
    if several and not track:
        raise InvalidOption("track is an empty list; give a name, or a list with one at least")
    return several


class SeveralTracks:
    """
    The same car on one of several tracks, drawn anew for each episode.

    :param worlds: one for each track; they have the same car and range finders
    """

    def __init__(self, worlds: Iterable[Backend]) -> None:
        self._worlds = tuple(worlds)
        self._enter(0)
        self.car = self._world.car
        self.gears: int = getattr(self._world, "gears", GEARS)
        self.range_finder_angles = self._world.range_finder_angles

    def _enter(self, place: int) -> None:
        self._world = self._worlds[place]
        self.track: Track = self._world.track

    def draw_track(self, rng: np.random.Generator) -> None:
        """Choose the next episode's track; see :class:`~sb3_torcs.backends.base.Backend`."""
        self._enter(int(rng.integers(len(self._worlds))))

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
        for world in self._worlds:
            world.close()
