"""Several worlds that take turns, one episode each, for agents that learn many tracks."""

from __future__ import annotations

import itertools
import pickle
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from typing import Any, Generic, Protocol, TypeGuard, TypeVar

import numpy as np

from sb3_torcs.backends.base import Backend, optional
from sb3_torcs.car import CarState, Controls, Start
from sb3_torcs.errors import InvalidOption
from sb3_torcs.torcs.car_file import CarFacts
from sb3_torcs.torcs.track_names import stable_track
from sb3_torcs.tracks.profile import RoadProfile
from sb3_torcs.tracks.track import Track

__all__ = [
    "Drawn",
    "SeveralWorlds",
    "Turn",
    "WorldPool",
    "is_several",
    "one_or_several",
    "present_world",
    "shared_worlds",
    "world_pool",
]


def is_several(choice: Any, name: str = "track") -> TypeGuard[Sequence[Any]]:
    """
    Check whether several tracks or cars are given.

    :param choice: what was given
    :param name: of the option
    :raises InvalidOption: if it is an empty list
    """
    several = isinstance(choice, Sequence) and not isinstance(choice, (str, bytes))
    if several and not choice:
        raise InvalidOption(f"{name} is an empty list; give a name, or a list with one at least")
    return several


class Closable(Protocol):
    """What a pool closes at the end."""

    def close(self) -> None:
        """Free all resources."""


World = TypeVar("World", bound=Closable)


class WorldPool(Generic[World]):
    """
    Worlds among which each episode draws. Environments of one kind may share them.

    One world of each choice is loaded at once, so that a wrong option is told at once. More of it
    are loaded when it is drawn and there is no spare one.

    :param makers: load a world of each choice
    """

    def __init__(self, makers: Iterable[Callable[[], World]]) -> None:
        self.makers = tuple(makers)
        self._spare: list[list[World]] = []
        self._users = 0
        try:
            for make in self.makers:
                self._spare.append([make()])
        except BaseException:
            self._close_spare()
            raise
        self.examples = tuple(world for (world,) in self._spare)
        """One world of each choice, to look up what holds for all of that choice."""

    def __len__(self) -> int:
        return len(self.makers)

    def join(self) -> None:
        """Take note of a user, who may take one world at a time."""
        self._users += 1

    def take(self, choice: int) -> World:
        """
        Take a world, in which its former user has left what it likes.

        :param choice: its index among the makers
        """
        return self._spare[choice].pop() if self._spare[choice] else self.makers[choice]()

    def give_back(self, choice: int, world: World) -> None:
        """
        Leave a world to those who draw it next.

        :param choice: its index among the makers
        :param world: from :meth:`take`
        """
        self._spare[choice].append(world)

    def leave(self) -> None:
        """Take note that a user has given its world back for good. The last one closes them all."""
        self._users -= 1
        if self._users == 0:
            self._close_spare()

    def _close_spare(self) -> None:
        for worlds in self._spare:
            while worlds:
                worlds.pop().close()


_shared: ContextVar[dict[bytes, WorldPool[Any]] | None] = ContextVar("_shared", default=None)


@contextmanager
def shared_worlds() -> Iterator[None]:
    """
    Let environments that are made in this context share their pools, where options are the same.

    Where each of 100 races had its own world of each of ten tracks, 1,000 would be loaded.
    """
    token = _shared.set({})
    try:
        yield
    finally:
        _shared.reset(token)


def world_pool(makers: Sequence[partial[World]]) -> WorldPool[World]:
    """
    Make a pool, or find the one that another environment has made in :func:`shared_worlds`.

    :param makers: as of :class:`WorldPool`
    """
    pools = _shared.get()
    if pools is None:
        return WorldPool(makers)
    try:
        key = pickle.dumps(makers)
    except (pickle.PicklingError, AttributeError, TypeError):  # no option can be of such a type
        return WorldPool(makers)  # and this says which of them is
    if key not in pools:
        pools[key] = WorldPool(makers)
    return pools[key]


def one_or_several(make: Callable[..., Backend], track: Any, car: Any) -> Backend:
    """
    Make the world of a track and a car, or several for each pair if a list is given.

    :param make: makes the world of ``track`` and ``car``
    :param track: or several
    :param car: or several
    :raises InvalidOption: if a list is empty
    """
    several = is_several(track), is_several(car, "car")
    track = stable_track(track)  # for copies, which may be made in another folder
    if not any(several):
        return make(track=track, car=car)
    tracks, cars = (track if several[0] else [track]), (car if several[1] else [car])
    pairs = itertools.product(tracks, cars)
    return SeveralWorlds(world_pool([partial(make, track=one, car=other) for one, other in pairs]))


class Turn(Generic[World]):
    """
    What one user of a pool has: the world that it has drawn.

    :param pool: of the worlds that can be drawn
    """

    def __init__(self, pool: WorldPool[World]) -> None:
        self.pool = pool
        self._index = 0  # of the world
        self.world = pool.take(0)
        pool.join()  # not before there is a world: who cannot get one never leaves
        self._closed = False

    def draw(self, rng: np.random.Generator) -> bool:
        """
        Draw the next world, and leave the present one to others if it is another.

        :param rng: of the environment whose episode begins
        :return: whether it is another
        """
        index = int(rng.integers(len(self.pool)))
        if index == self._index:
            return False
        world = self.pool.take(index)
        self.pool.give_back(self._index, self.world)
        self._index, self.world = index, world
        return True

    def close(self) -> None:
        """Leave the worlds to others; the last one closes them. A second call does nothing."""
        if not self._closed:
            self._closed = True
            self.pool.give_back(self._index, self.world)
            self.pool.leave()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "pool": self.pool.makers}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.pool = WorldPool(state["pool"])
        self.pool.join()
        if self._closed:  # so is the copy
            self.pool.leave()


class Drawn(ABC):
    """A backend that passes on what the world of the present episode says."""

    @property
    @abstractmethod
    def world(self) -> Any:
        """The world of the present episode."""

    @property
    def track(self) -> Track:
        """The track of the present episode."""
        track: Track = self.world.track
        return track

    @property
    def car(self) -> str:
        """Name of the car of the present episode."""
        car: str = self.world.car
        return car

    @property
    def profile(self) -> RoadProfile | None:
        """The road of the present episode, if it has hills."""
        return optional(self.world, "profile")

    @property
    def facts(self) -> CarFacts | None:
        """What the file of the present episode's car says, if its world knows."""
        return optional(self.world, "facts")


class SeveralWorlds(Drawn):
    """
    One of several cars on one of several tracks: each episode draws a pair of them.

    :param pool: of a world for each track and car; they have the same range finders
    """

    def __init__(self, pool: WorldPool[Backend]) -> None:
        self._turn = Turn(pool)
        self.gears: int = min(optional(world, "gears") for world in pool.examples)
        self.range_finder_angles = self.world.range_finder_angles
        self.tells_race = all(optional(world, "tells_race") for world in pool.examples)
        self.conditions: Sequence[str] = optional(self.world, "conditions")

    @property
    def world(self) -> Any:
        """The world of the present episode."""
        return self._turn.world

    def draw_track(self, rng: np.random.Generator) -> None:
        """Choose the next episode's world; see :class:`~sb3_torcs.backends.base.Backend`."""
        if self._turn.draw(rng) and self.conditions:
            self.set_conditions(1.0, 1.0)  # whatever another environment has set
        draw_within = optional(self.world, "draw_track")  # of a world of random tracks
        if draw_within is not None:
            draw_within(rng)

    def set_conditions(self, grip: float, mass: float) -> None:
        """Change the next episode's world; see :class:`~sb3_torcs.backends.base.Backend`."""
        self.world.set_conditions(grip, mass)

    def reset(self, rng: np.random.Generator, start: Start | None) -> CarState:
        """Begin an episode; see :class:`~sb3_torcs.backends.base.Backend`."""
        car: CarState = self.world.reset(rng, start)
        return car

    def step(self, controls: Controls, ticks: int) -> CarState:
        """Drive on; see :class:`~sb3_torcs.backends.base.Backend`."""
        car: CarState = self.world.step(controls, ticks)
        return car

    def close(self) -> None:
        """Leave the worlds to others; the last one closes them."""
        self._turn.close()


def present_world(backend: Backend) -> Backend:
    """
    Return the world of the present episode.

    :param backend: one world, or several
    """
    world: Backend = getattr(backend, "world", backend)
    return world
