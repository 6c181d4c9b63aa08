"""Races as the game holds them: a grid, laps, the flag, and the standings."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from sb3_torcs.agents.drivers import NamedDriver
from sb3_torcs.agents.pilots import Pilots, check_racers
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
from sb3_torcs.telemetry import DriveLabel, DriveLog
from sb3_torcs.torcs.starting_list import GRID_SLOTS, GRIDS, GridName
from sb3_torcs.tracks.catalogue import stable_name
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
    contacts: int  # with other cars
    out: bool  # did not finish
    distance: float = field(repr=False, default=0.0)  # [m]

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

    def look(self) -> bool:
        """Look at the race, a control tick later; return whether it may go on."""


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
        track = stable_name(road)
        self._labels = [
            DriveLabel(name, track, engine.car_name(slot), "Torcs-v0")
            for slot, name in enumerate(names)
        ]

    def look(self) -> bool:
        """See :class:`Watcher`."""
        for slot, label in enumerate(self._labels):
            controls = Controls(*self._engine.controls(slot))
            self._log.add(label, self._engine.read(slot), controls)
        return True


def run_races(
    drivers: Sequence[NamedDriver],
    hold: Callable[[Sequence[NamedDriver], int], Race],
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

    :param drivers: the drivers; the first one takes part in every race
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
    size = len(drivers) if field_size is None else field_size
    if not 1 <= size <= len(drivers):
        raise InvalidOption(
            f"{size} drivers in each race, by --field or field_size; expected a whole number from "
            f"1 to {len(drivers)}, as many as there are"
        )
    if size > GRID_SLOTS:
        raise InvalidOption(
            f"{size} drivers in a race; a grid has room for {GRID_SLOTS}: name fewer, or draw some "
            f"for each race with --field {GRID_SLOTS} (from Python: field_size={GRID_SLOTS})"
        )

    def held() -> Iterator[Race]:  # what is checked above is refused before the first race
        before: list[str] = []
        for number in range(seed, seed + races):
            order = _grid(drivers, size, grid, before, np.random.default_rng(number))
            race = hold(order, number)
            before = [standing.driver for standing in race.standings]
            yield race

    return held()


def _grid(
    drivers: Sequence[NamedDriver],
    size: int,
    grid: GridName,
    before: list[str],
    rng: np.random.Generator,
) -> list[NamedDriver]:
    """Draw who stands on the grid, and where; the one in front comes first."""
    others = [drivers[1 + i] for i in rng.permutation(len(drivers) - 1)[: size - 1]]
    if grid == "last":
        return [*others, drivers[0]]
    order = [[drivers[0], *others][i] for i in rng.permutation(size)]
    if grid == "reverse" and before:
        order.sort(key=lambda e: -before.index(e.name) if e.name in before else 0)
    return order


def run_race(
    order: Sequence[NamedDriver],
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
    if len(order) > 1:
        check_racers(order)
    agents = [driver for driver in order if driver.robot is None]
    numbers = iter(range(len(agents)))
    entries = [driver.robot or ("", next(numbers)) for driver in order]
    engine, road = load_race(
        track,
        entries,
        cars=[agent.car for agent in agents],
        gearboxes=[agent.gearbox for agent in agents],
        angles=[agent.angles for agent in agents],
        laps=laps,
        flagged=True,
    )
    names = [driver.name for driver in order]
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
            if not _drive(engine, ticks, watchers):
                yield
                return
            tick += ticks
        yield
        if all(out or engine.finished(car) for car, *_, out in engine.results()):
            return


def _drive(engine: Engine, ticks: int, watchers: Sequence[Watcher]) -> bool:
    """Drive on, as far as the race goes; return whether all watchers let it go on."""
    if not watchers:
        engine.drive(ticks)
        return True
    for _ in range(ticks):
        if engine.ended:  # what has been looked at already
            return True
        engine.drive(1)
        if not all([watcher.look() for watcher in watchers]):
            return False
    return True


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
