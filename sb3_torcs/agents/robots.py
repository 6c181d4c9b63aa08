"""The game's robots, driven by the engine: lap times, results, and the drives."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from sb3_torcs.backends.native import make_engine
from sb3_torcs.car import Controls
from sb3_torcs.telemetry import DriveLabel, DriveLog
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.race_results import Lap, RobotResult
from sb3_torcs.torcs.race_setup import RaceSetup, Session
from sb3_torcs.torcs.track_names import find_track
from sb3_torcs.tracks.catalogue import load_track, stable_name

__all__ = ["race"]

TICKS_AT_ONCE = 50  # a second of the race
WORLD = "Torcs-v0"  # the same physics


def race(
    robots: Sequence[tuple[str, int]],
    track: str,
    laps: int,
    *,
    session: Session = "practice",
    log: DriveLog | None = None,
) -> list[RobotResult]:
    """
    Let robots drive a race by the engine.

    :param robots: names and indices, the first one at the head of the grid
    :param track: ``"aalborg"``, ``"road/aalborg"``, or the path of a TORCS XML file
    :param laps: to drive
    :param session: the game's ``"practice"``, or ``"race"``
    :param log: gets a row per robot and control tick
    :return: one result per robot, the winner first
    :raises InvalidOption: if the session cannot be had
    :raises BackendUnavailable: if the game or the extension is missing
    """
    with _engine(robots, track, laps, session) as engine:
        if log is not None:
            _note(engine, robots, track, log)
        while not engine.ended:
            engine.advance(TICKS_AT_ONCE)
        return [
            _result(engine, robots, rank, row) for rank, row in enumerate(engine.results(), start=1)
        ]


@contextmanager
def _engine(
    robots: Sequence[tuple[str, int]], track: str, laps: int, session: Session
) -> Iterator[Any]:
    """Start a race, and close its engine at the end."""
    RaceSetup(track, robots, laps, session)  # refuses races that the game itself cannot run
    engine = make_engine(find_game(), track, robots, session=session, laps=laps)
    try:
        engine.start()
        yield engine
    finally:
        engine.close()


def _result(
    engine: Any, robots: Sequence[tuple[str, int]], rank: int, row: tuple[Any, ...]
) -> RobotResult:
    entry, laps_completed, total_time, best_lap, damage, _ = row
    name, index = robots[entry]
    return RobotResult(
        robot=name,
        index=index,
        car=engine.car_name(entry),
        laps=[Lap(time, damage) for time, damage in engine.laps(entry)],
        total_time=total_time,
        rank=rank,
        damage=damage,
        out=not engine.finished(entry),
        laps_completed=laps_completed,
        best_lap=best_lap or None,
    )


def _note(engine: Any, robots: Sequence[tuple[str, int]], track: str, log: DriveLog) -> None:
    """Drive to the end of the race, and note each control tick."""
    game = find_game()
    road = load_track(find_track(track, game))
    labels = [
        DriveLabel(game.robot_name(robot), stable_name(road), engine.car_name(number), WORLD)
        for number, robot in enumerate(robots)
    ]
    log.tracks |= dict.fromkeys(labels, road)
    while not engine.ended:
        engine.advance(1)
        for number, label in enumerate(labels):
            controls = Controls(*engine.controls(number)[:4])
            log.add(label, engine.read(number), controls)
