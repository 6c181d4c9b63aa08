"""What worlds of the engine have in common: the road of a loaded race, and the facts of a car."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

from sb3_torcs.torcs.car_file import CarFacts, car_facts
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.tracks.profile import RoadProfile, game_profile
from sb3_torcs.tracks.track import Track

if TYPE_CHECKING:
    from sb3_torcs._engine import Engine

__all__ = ["EngineWorld", "align"]

MIN_SHIFT = 1.0  # [m] between the game's frame and the track's, from which positions are moved

_profiles: WeakKeyDictionary[Track, RoadProfile] = WeakKeyDictionary()
"""Of tracks that were looked ahead on. Races on one track share it."""


class EngineWorld:
    """A car in a race of the real game."""

    engine: Engine
    seat: int  # of the car, in the starting list
    track: Track
    car: str

    @cached_property
    def profile(self) -> RoadProfile:
        """The road with its hills; see :class:`~sb3_torcs.backends.base.Backend`."""
        if self.track not in _profiles:
            _profiles[self.track] = game_profile(self.engine.road())
        return _profiles[self.track]

    @cached_property
    def facts(self) -> CarFacts:
        """What the car's file says; see :class:`~sb3_torcs.backends.base.Backend`."""
        return car_facts(find_game().find_car(self.car))


def align(engine: Engine, track: Track) -> None:
    """
    Move positions into the track's frame: the game counts one track's origin otherwise.

    :param engine: of a race
    :param track: the same road as it was read from its file
    """
    there = engine.track_summary()
    x, y, _ = track.pose(0.0)
    if abs(x - there["x"]) > MIN_SHIFT or abs(y - there["y"]) > MIN_SHIFT:
        engine.set_origin(x - there["x"], y - there["y"])
