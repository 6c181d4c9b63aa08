"""Several agents in one race of the real game: each has a seat, the world of its environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

import numpy as np

from sb3_torcs.backends.engine_world import EngineWorld
from sb3_torcs.backends.several import Drawn, Turn, WorldPool
from sb3_torcs.car import CarState, Controls, FloatArray, Start
from sb3_torcs.errors import InvalidOption
from sb3_torcs.tracks.track import Track

if TYPE_CHECKING:
    from sb3_torcs._engine import Engine

__all__ = [
    "REJOIN_SPEED",
    "LoadedRace",
    "LoneSeat",
    "Seat",
    "SeatWorld",
    "SharedRace",
]

REJOIN_SPEED = 20.0
"""[m/s] of a car that is put back on the road, where no start was drawn for it."""


class SeatWorld(EngineWorld):
    """
    The car of an agent in a race that is loaded.

    :param engine: that all cars of the race share
    :param seat: of the car, in the starting list
    :param track: of the race
    :param angles: (19,) of the car's range finders [rad], left negative
    """

    def __init__(self, engine: Engine, seat: int, track: Track, angles: FloatArray) -> None:
        self.engine, self.seat, self.track = engine, seat, track
        self.range_finder_angles = angles
        self.car = engine.car_name(seat)
        self.gears = engine.gears(seat)

    def arrive(self, controls: Controls, ticks: int, state: CarState) -> None:
        """Take the result of a step, of which nothing has to be remembered."""


class LoadedRace(NamedTuple):
    """A race that is loaded."""

    worlds: Sequence[SeatWorld]  # the cars of its agents
    opponents: Any = None  # those that are agents; see ``agents.pilots.AgentOpponents``
    flagged: bool = False  # whether its agents are flagged off after the last lap

    def close(self) -> None:
        """Close the race."""
        self.worlds[0].engine.close()


class SharedRace:
    """
    A race whose agents begin and end their episodes one by one.

    It begins on the grid, or with the whole field somewhere on the road. An agent whose episode
    ends rejoins: its car is put down in the middle of the longest stretch of road without cars,
    repaired, and its next episode begins there, while the others race on. When all agents have
    ended the episode that they began the race with, the race is over, and the next reset begins
    another one, on a track and in a field that are drawn again.

    :param races: among which it is drawn
    :param noise: whether sensors err as those of the SCR server's ``-noisy``
    """

    def __init__(self, races: WorldPool[LoadedRace], noise: bool = False) -> None:
        self._turn = Turn(races)
        self._tick = 0  # control ticks since the race began
        self._asked = -1  # when the opponents that are agents were asked
        self.agents = len(self.loaded.worlds)
        self._noise = noise
        self._waiting: set[int] = set()  # agents that have not begun an episode in this race
        self._lasting: set[int] = set()  # agents whose first episode in this race goes on
        self._open = self.agents
        self.seats = [Seat(self, number) for number in range(self.agents)]

    @classmethod
    def of(cls, worlds: Sequence[SeatWorld]) -> SharedRace:
        """
        Share one race, which is loaded.

        :param worlds: the cars of its agents
        """
        return cls(WorldPool([lambda: LoadedRace(worlds)]))

    @property
    def loaded(self) -> LoadedRace:
        """The present race."""
        return self._turn.world

    def world(self, number: int) -> SeatWorld:
        """
        Return the car of an agent in the present race.

        :param number: of the agent
        """
        return self.loaded.worlds[number]

    def gears(self, number: int) -> int:
        """
        Return how many gears the car of an agent has, at least, in the races that can be drawn.

        :param number: of the agent
        """
        return min(race.worlds[number].gears for race in self._turn.pool.examples)

    def is_over(self, ending: set[int]) -> bool:
        """
        Check whether the race is over when some episodes end.

        :param ending: numbers of the agents whose episodes end now
        """
        return self._lasting <= ending

    def end(self) -> None:
        """End the race: the next reset of an agent begins another."""
        self._waiting, self._lasting = set(), set()

    def draw(self, rng: np.random.Generator) -> None:
        """
        Choose the next race.

        :param rng: of the environment whose reset begins it
        """
        self._turn.draw(rng)

    def begins_with(self, number: int) -> bool:
        """
        Check whether the next reset of an agent begins a race.

        :param number: of the agent
        """
        return number not in self._waiting and self._lasting <= {number}

    def reset(self, number: int, rng: np.random.Generator, start: Start | None) -> CarState:
        """
        Begin an episode of an agent.

        :param number: of the agent
        :param rng: the generator of its environment
        :param start: of the field if a race begins; where along the road does not count for a car
            that rejoins; nothing counts for one that begins a race with another
        :return: the car
        """
        world = self.world(number)
        if self.begins_with(number):
            self._begin(rng, start, world.engine)
            self._waiting = set(range(self.agents)) - {number}
            self._lasting = set(range(self.agents))
        elif number in self._waiting:
            self._waiting.discard(number)
        else:
            self._lasting.discard(number)
            _, *place = start or Start(0.0, speed=REJOIN_SPEED)
            world.engine.rejoin(world.seat, *place)
        return world.engine.read(world.seat)

    def _begin(self, rng: np.random.Generator, start: Start | None, engine: Engine) -> None:
        engine.set_noise(int(rng.integers(2**63)) if self._noise else None)
        if start is None:
            engine.start()
        else:
            engine.start_at(*start)
        self._tick, self._asked = 0, -1
        if self.loaded.opponents is not None:
            self.loaded.opponents.begin()

    def join(self) -> None:
        """Let all agents begin in a race that is begun elsewhere."""
        self._waiting = set(range(self.agents))
        self._lasting = set(self._waiting)

    def ask(self) -> None:
        """Ask the opponents that are agents what they do next, once before each timestep."""
        if self.loaded.opponents is not None and self._asked != self._tick:
            engine = self.world(0).engine
            muted = engine.mute_noise(False)  # opponents see with noise, whatever looks on
            try:
                self.loaded.opponents.act(self._tick)
            finally:
                engine.mute_noise(muted)
            self._asked = self._tick

    def advance(self, ticks: int) -> None:
        """
        Take note that the race was driven.

        :param ticks: control ticks
        """
        self._tick += ticks

    def drive(self, ticks: int) -> None:
        """
        Drive the whole race on; each agent does what it holds.

        :param ticks: control ticks of 0.02 s
        """
        self.ask()
        self.world(0).engine.drive(ticks)
        self.advance(ticks)

    def leave(self) -> None:
        """Leave the race to others when the last seat is left."""
        self._open -= 1
        if self._open == 0:
            self._turn.close()


class Seat(Drawn):
    """
    The world of one agent of a shared race; see :class:`~sb3_torcs.backends.base.Backend`.

    :param race: that it is in
    :param number: of the agent, from 0
    """

    tells_race = True
    conditions = ("sensor_noise",)

    def __init__(self, race: SharedRace, number: int) -> None:
        self.race, self.number = race, number
        self.gears = race.gears(number)
        self.range_finder_angles = self.world.range_finder_angles
        self._closed = False

    @property
    def shares_race(self) -> bool:
        """Whether other agents are stepped with this one."""
        return self.race.agents > 1

    @property
    def world(self) -> SeatWorld:
        """The agent's car in the present race."""
        return self.race.world(self.number)

    def draw_track(self, rng: np.random.Generator) -> None:
        """Choose the next race, if it begins now; see ``Backend``."""
        if self.race.begins_with(self.number):
            self.race.draw(rng)

    def reset(self, rng: np.random.Generator, start: Start | None) -> CarState:
        """Begin an episode; see :meth:`SharedRace.reset`."""
        return self.race.reset(self.number, rng, start)

    def step(self, controls: Controls, ticks: int) -> NoReturn:
        """Refuse to drive one car of several."""
        del controls, ticks
        raise InvalidOption(
            f"the {self.race.agents} agents of this race drive at once; step the whole vector "
            "environment"
        )

    def hold(self, controls: Controls) -> None:
        """
        Say what the agent does from its next call on.

        :param controls: finite and within their ranges
        """
        self.world.engine.hold(self.world.seat, *controls)

    def read(self) -> CarState:
        """Return the car as it is."""
        return self.world.engine.read(self.world.seat)

    def retire(self) -> None:
        """Take the car off the road, until another race begins."""
        self.world.engine.retire(self.world.seat)

    @property
    def finished(self) -> bool:
        """Whether the car was flagged off."""
        return self.world.engine.finished(self.world.seat)

    def close(self) -> None:
        """Leave the race, which is closed by the last one."""
        if not self._closed:
            self._closed = True
            self.race.leave()

    def __reduce__(self) -> NoReturn:
        raise InvalidOption(
            "an environment that shares its race with other agents cannot be copied or sent to "
            "another process; make another one there"
        )


class LoneSeat(Seat):
    """The world of the only agent of a shared race that is stepped; others drive by themselves."""

    def step(self, controls: Controls, ticks: int) -> CarState:  # type: ignore[override]
        """Drive on; see :class:`~sb3_torcs.backends.base.Backend`."""
        self.hold(controls)
        self.race.drive(ticks)
        return self.read()
