"""Races as the game holds them: a grid, laps, the flag, and the standings."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from sb3_torcs.agents.pilots import Pilots
from sb3_torcs.backends.native import load_race
from sb3_torcs.backends.seats import SeatWorld, SharedRace
from sb3_torcs.car import (
    CONTROL_TICK,
    Controls,
    FloatArray,
    check_count,
    checked_choice,
    checked_laps,
)
from sb3_torcs.errors import InvalidOption
from sb3_torcs.races.entrants import Entrant
from sb3_torcs.telemetry import DriveLabel, DriveLog
from sb3_torcs.torcs.starting_list import GRID_SLOTS, GRIDS, GridName
from sb3_torcs.tracks.catalogue import lasting_name
from sb3_torcs.tracks.track import Track

if TYPE_CHECKING:
    from sb3_torcs._engine import Engine

__all__ = [
    "Notes",
    "Race",
    "Standing",
    "Watcher",
    "behind_the_line",
    "run_race",
    "run_races",
]


LOOK = 50  # [control ticks] a second, after which the race is looked at
SLOWEST = 10.0  # [m/s] below which the game takes a car out, for a lap and ...
PIT_STOP = 84.5  # [s] ... for a stop in it
LOST = "the game's physics has divided by zero, and its car is nowhere"


@dataclass(frozen=True)
class Standing:
    """Where a driver came in a race."""

    driver: str
    place: int
    grid_slot: int
    laps: int
    time: float  # [s] with penalties, of whole laps
    best_lap: float | None  # [s] of those that count
    damage: float  # [points]
    contacts: int | None  # with other cars; the game itself does not count them
    out: bool  # did not finish
    distance: float | None = field(repr=False, default=0.0)  # [m] which the game does not tell

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as the command prints them: times in whole milliseconds."""
        fields = asdict(self)
        del fields["distance"]
        best = self.best_lap
        times = {"time": round(self.time, 3), "best_lap": None if best is None else round(best, 3)}
        return fields | times


@dataclass(frozen=True)
class Race:
    """One race. In its arrays a row is a moment, and a column a grid slot."""

    seed: int
    standings: list[Standing]  # the winner first
    failures: dict[str, str]  # why drivers were taken out: what they answered, or a lost car
    drivers: list[str]  # by grid slot
    distances: FloatArray  # (moments, cars) [m] from the start line on
    places: Any  # (moments, cars)
    goal: float = math.inf  # [m] from the start line on, where the race ends


class Watcher(Protocol):
    """What looks at a race after each control tick."""

    def begin(self, engine: Engine, names: Sequence[str], road: Track) -> None:
        """
        Look at the grid.

        :param engine: of a race that begins
        :param names: of the drivers, by grid slot
        :param road: of the race
        """

    def look(self) -> None:
        """Look at the race, a control tick later."""


class Notes:
    """
    Notes the drives of all cars.

    :param log: that is written
    """

    def __init__(self, log: DriveLog) -> None:
        self._log = log

    def begin(self, engine: Engine, names: Sequence[str], road: Track) -> None:
        """See :class:`Watcher`."""
        self._engine = engine
        track = lasting_name(road)
        self._labels = [
            DriveLabel(name, track, engine.car_name(slot), "Torcs-v0")
            for slot, name in enumerate(names)
        ]

    def look(self) -> None:
        """See :class:`Watcher`."""
        for slot, label in enumerate(self._labels):
            controls = Controls(*self._engine.controls(slot))
            self._log.add(label, self._engine.read(slot), controls)


def run_races(
    entrants: Sequence[Entrant],
    hold: Callable[[Sequence[Entrant], int], Race],
    *,
    races: int,
    grid: GridName = "last",
    field_size: int | None = None,
    seed: int = 0,
) -> Iterator[Race]:
    """
    Hold races one after the other.

    Worlds and drivers are deterministic, so what differs between races is the grid, and with
    ``field_size`` who stands on it; both are drawn from the seed of the race.

    :param entrants: the drivers; the first one takes part in every race
    :param hold: holds a race of drivers, the one in front first; with the seed of the race
    :param races: their number
    :param grid: ``"last"``: the first driver behind all others, who are drawn; ``"random"``: all
        are drawn; ``"reverse"``: in the reverse order of the race before, the first one drawn
    :param field_size: cars in each race, the others are drawn; ``None`` is all
    :param seed: of the first race; the others have the next ones
    :raises InvalidOption: if no such races can be held
    """
    checked_choice("grid", grid, GRIDS)
    check_count("races", races)
    size = len(entrants) if field_size is None else field_size
    if not 1 <= size <= len(entrants):
        raise InvalidOption(
            f"{size} drivers in each race, by --field or field_size; expected a whole number from "
            f"1 to {len(entrants)}, as many as there are"
        )
    if size > GRID_SLOTS:
        raise InvalidOption(
            f"{size} drivers in a race; a grid has room for {GRID_SLOTS}: name fewer, or draw some "
            f"for each race with --field {GRID_SLOTS} (from Python: field_size={GRID_SLOTS})"
        )

    def held() -> Iterator[Race]:  # what is checked above is refused before the first race
        before: list[str] = []
        for number in range(seed, seed + races):
            order = _grid(entrants, size, grid, before, np.random.default_rng(number))
            race = hold(order, number)
            before = [standing.driver for standing in race.standings]
            yield race

    return held()


def _grid(
    entrants: Sequence[Entrant],
    size: int,
    grid: GridName,
    before: list[str],
    rng: np.random.Generator,
) -> list[Entrant]:
    """Draw who stands on the grid, and where; the one in front comes first."""
    others = [entrants[1 + i] for i in rng.permutation(len(entrants) - 1)[: size - 1]]
    if grid == "last":
        return [*others, entrants[0]]
    order = [[entrants[0], *others][i] for i in rng.permutation(size)]
    if grid == "reverse" and before:
        order.sort(key=lambda e: -before.index(e.name) if e.name in before else 0)
    return order


def run_race(
    order: Sequence[Entrant],
    track: str,
    *,
    laps: int,
    seed: int = 0,
    trust: bool = False,
    watchers: Sequence[Watcher] = (),
    progress: Callable[[float], object] = float,
) -> Race:
    """
    Hold a race by the game's rules: who crosses the line after the winner has finished.

    :param order: the drivers, the one in front first
    :param track: as of ``Torcs-v0``
    :param laps: to drive
    :param seed: which is kept with the race
    :param trust: as of :class:`~sb3_torcs.agents.pilots.Pilots`
    :param watchers: that look at it
    :param progress: called now and then with the share of the race that is over, 0 to 1
    :raises ModelMismatch: if an agent does not fit this race
    """
    checked_laps(laps)
    agents = [entrant.agent for entrant in order if entrant.agent is not None]
    numbers = iter(range(len(agents)))
    entries = [entrant.robot or ("", next(numbers)) for entrant in order]
    engine, road = load_race(
        track,
        entries,
        cars=[agent.car for agent in agents],
        gearboxes=[agent.gearbox for agent in agents],
        angles=[agent.angles for agent in agents],
        laps=laps,
        flagged=True,
    )
    names = [entrant.name for entrant in order]
    pilots: Pilots | None = None
    moments: list[list[tuple[float, int]]] = []
    try:
        if agents:
            grid = [
                SeatWorld(engine, seat, road, agent.angles)
                for seat, agent in zip(engine.agents, agents, strict=True)
            ]
            pilots = Pilots(agents, SharedRace.of(grid), trust)
            pilots.begin(seed)
        else:
            engine.start()
        for watcher in watchers:
            watcher.begin(engine, names, road)
        starts = behind_the_line(engine, road, len(order))
        limit = (laps + 1) * (PIT_STOP + road.length / SLOWEST)
        for _ in _stretches(engine, pilots, limit, watchers):
            cars = [engine.read(number) for number in range(len(order))]
            moments.append([(car.distance_raced, car.race_position) for car in cars])
            progress(min(max(car.distance_raced for car in cars) / (laps * road.length), 1.0))
        standings = _standings(engine, names)
        failed = {} if pilots is None else pilots.failed
        seats = engine.agents
        failures = {names[seats[number]]: why for number, why in failed.items()}
        lost = [name for slot, name in enumerate(names) if engine.lost(slot)]
        failures |= dict.fromkeys(lost, LOST)
    finally:
        engine.close()
    trace = np.array(moments)
    distances, places = trace[..., 0] - starts, trace[..., 1].astype(int)
    return Race(seed, standings, failures, names, distances, places, laps * road.length)


def behind_the_line(engine: Engine, road: Track, cars: int) -> FloatArray:
    """
    Measure how far the grid slots are behind the start line [m].

    :param engine: of a race that begins
    :param road: of the race
    :param cars: their number
    """
    places = np.array([engine.read(slot).distance_from_start for slot in range(cars)])
    return (road.length - places) % road.length


def _stretches(
    engine: Engine, pilots: Pilots | None, limit: float, watchers: Sequence[Watcher]
) -> Iterator[None]:
    """
    Drive to the end of the race, a second at a time.

    :param engine: with the race
    :param pilots: of the agents
    :param limit: of the race [s]
    :param watchers: that look at it after every control tick
    """
    tick = 0
    while tick * CONTROL_TICK < limit and not engine.ended:
        look = tick + LOOK
        while tick < look and not engine.ended:
            ticks = look - tick if pilots is None else min(pilots.act(tick), look - tick)
            _drive(engine, ticks, watchers)
            tick += ticks
        yield
        if all(out or engine.finished(car) for car, *_, out in engine.results()):
            return


def _drive(engine: Engine, ticks: int, watchers: Sequence[Watcher]) -> None:
    """Drive on, as far as the race goes."""
    if not watchers:
        engine.drive(ticks)
        return
    for _ in range(ticks):
        if engine.ended:  # what has been looked at already
            return
        engine.drive(1)
        for watcher in watchers:
            watcher.look()


def _standings(engine: Engine, names: Sequence[str]) -> list[Standing]:
    standings = []
    for place, (slot, laps, time, best, damage, _) in enumerate(engine.results(), start=1):
        car = engine.read(slot)
        standings.append(
            Standing(
                names[slot], place, slot + 1, laps, time, best or None, float(damage),
                int(car.contacts), not engine.finished(slot), car.distance_raced,
            )
        )  # fmt: skip
    return standings
