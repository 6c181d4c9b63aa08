"""The game's robots, driven by the engine: lap times, results, and the drive itself."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from sb3_torcs.backends.native import make_engine
from sb3_torcs.errors import InvalidOption
from sb3_torcs.telemetry import STATE_FIELDS, write_telemetry
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.race_results import Lap, RobotResult
from sb3_torcs.torcs.race_setup import RaceSetup, Session

__all__ = ["race"]

TICKS_AT_ONCE = 50  # a second of the race
MAX_ROBOTS = 20  # that a grid of the game's tracks has room for


def race(
    robots: Sequence[tuple[str, int]],
    track: str,
    laps: int,
    *,
    session: Session = "practice",
    telemetry: Path | None = None,
) -> list[RobotResult]:
    """
    Let robots drive a race by the engine.

    :param robots: names and indices, the first one at the head of the grid
    :param track: ``"aalborg"``, ``"road/aalborg"``, or the path of a TORCS XML file
    :param laps: to drive
    :param session: the game's ``"practice"``, or ``"race"``
    :param telemetry: CSV file for the drive itself, see :mod:`sb3_torcs.telemetry`
    :return: one result per robot, the winner first
    :raises InvalidOption: if the session cannot be had
    :raises BackendUnavailable: if the game or the extension is missing
    """
    if not robots or len(robots) > MAX_ROBOTS:
        raise InvalidOption(f"{len(robots)} robots; expected 1 to {MAX_ROBOTS}")
    RaceSetup(track, robots, laps, session)  # refuses races that the game itself cannot run
    engine = make_engine(find_game(), track, robots, session=session, laps=laps)
    try:
        engine.start()
        if telemetry is None:
            while not engine.ended:
                engine.advance(TICKS_AT_ONCE)
        else:
            write_telemetry(telemetry, _rows(engine, robots))
        return [
            _result(engine, robots, rank, row) for rank, row in enumerate(engine.results(), start=1)
        ]
    finally:
        engine.close()


def _result(
    engine: Any, robots: Sequence[tuple[str, int]], rank: int, row: tuple[Any, ...]
) -> RobotResult:
    entry, laps_completed, total_time, best_lap, damage, out = row
    name, index = robots[entry]
    return RobotResult(
        robot=name,
        index=index,
        car=engine.car_name(entry),
        laps=[Lap(time, damage) for time, damage in engine.laps(entry)],
        total_time=total_time,
        rank=rank,
        damage=damage,
        out=out,
        laps_completed=laps_completed,
        best_lap=best_lap or None,
    )


def _rows(engine: Any, robots: Sequence[tuple[str, int]]) -> Iterator[tuple[Any, ...]]:
    """Drive to the end of the race, and yield the rows of each control tick."""
    while not engine.ended:
        engine.advance(1)
        for car, robot in enumerate(robots):
            yield (*robot, *engine.read(car)[: len(STATE_FIELDS)], *engine.controls(car))
