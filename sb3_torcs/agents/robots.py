"""The game's robots, driven by the engine: lap times, results, and the drive itself."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sb3_torcs.backends.native import make_engine
from sb3_torcs.car import CarState, Controls
from sb3_torcs.errors import OutputNotWritable
from sb3_torcs.telemetry import STATE_FIELDS, DriveLabel, DriveLog, write_telemetry
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.race_results import Lap, RobotResult
from sb3_torcs.torcs.race_setup import RaceSetup, Session
from sb3_torcs.torcs.track_names import find_track
from sb3_torcs.tracks.catalogue import lasting_name, load_track

__all__ = ["PARQUET", "drive_log", "race", "race_to_its_end"]

TICKS_AT_ONCE = 50  # a second of the race
PARQUET = ".parquet"
"""Ending of files that :mod:`sb3_torcs.telemetry.drives` writes; all others are CSV."""
WORLD = "Torcs-v0"  # the same physics


def race(
    robots: Sequence[tuple[str, int]],
    track: str,
    laps: int,
    *,
    session: Session = "practice",
    telemetry: str | Path | None = None,
) -> list[RobotResult]:
    """
    Let robots drive a race by the engine.

    :param robots: names and indices, the first one at the head of the grid
    :param track: ``"aalborg"``, ``"road/aalborg"``, or the path of a TORCS XML file
    :param laps: to drive
    :param session: the game's ``"practice"``, or ``"race"``
    :param telemetry: file for the drive itself, Parquet or CSV; see :mod:`sb3_torcs.telemetry`
    :return: one result per robot, the winner first
    :raises InvalidOption: if the session cannot be had
    :raises BackendUnavailable: if the game or the extension is missing
    :raises OutputNotWritable: if the file cannot be written
    """
    results, unwritten = race_to_its_end(robots, track, laps, session, telemetry)
    if unwritten is not None:
        raise unwritten
    return results


def race_to_its_end(
    robots: Sequence[tuple[str, int]],
    track: str,
    laps: int,
    session: Session = "practice",
    telemetry: str | Path | None = None,
) -> tuple[list[RobotResult], OutputNotWritable | None]:
    """
    Let robots drive as :func:`race` does, and keep the results if the file cannot be written.

    :param robots: as of :func:`race`
    :param track: as of :func:`race`
    :param laps: as of :func:`race`
    :param session: as of :func:`race`
    :param telemetry: as of :func:`race`
    :return: one result per robot, the winner first; and why there is no file, if there is none
    :raises InvalidOption: if the session cannot be had
    :raises BackendUnavailable: if the game or the extension is missing
    """
    unwritten = None
    with _engine(robots, track, laps, session) as engine:
        try:
            if telemetry is not None:
                _write_drive(engine, robots, track, Path(telemetry))
        except OutputNotWritable as error:
            unwritten = error
        while not engine.ended:  # there is no file, or no more room for it
            engine.advance(TICKS_AT_ONCE)
        results = [
            _result(engine, robots, rank, row) for rank, row in enumerate(engine.results(), start=1)
        ]
    return results, unwritten


def _write_drive(engine: Any, robots: Sequence[tuple[str, int]], track: str, file: Path) -> None:
    """Drive to the end of the race, and write the drive."""
    if file.suffix.lower() == PARQUET:
        _log(engine, robots, track).write(file)
    else:
        write_telemetry(file, _rows(engine, robots))


def drive_log(
    robots: Sequence[tuple[str, int]], track: str, laps: int, *, session: Session = "practice"
) -> DriveLog:
    """
    Let robots drive, and note what they do.

    :param robots: as of :func:`race`
    :param track: as of :func:`race`
    :param laps: as of :func:`race`
    :param session: as of :func:`race`
    :return: a row per robot and control tick
    """
    with _engine(robots, track, laps, session) as engine:
        return _log(engine, robots, track)


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


def _rows(engine: Any, robots: Sequence[tuple[str, int]]) -> Iterator[tuple[Any, ...]]:
    """Drive to the end of the race, and yield the rows of each control tick."""
    for number, car, controls in _ticks(engine, len(robots)):
        yield (*robots[number], *car[: len(STATE_FIELDS)], *controls)


def _log(engine: Any, robots: Sequence[tuple[str, int]], track: str) -> DriveLog:
    """Drive to the end of the race, and note each control tick."""
    name = lasting_name(load_track(find_track(track, find_game())))
    labels = [
        DriveLabel(_named(robot), name, engine.car_name(number), WORLD)
        for number, robot in enumerate(robots)
    ]
    log = DriveLog()
    for number, car, controls in _ticks(engine, len(robots)):
        log.add(labels[number], car, Controls(*controls))
    return log


def _named(robot: tuple[str, int]) -> str:
    """Return the shortest name of a robot's driver, as one types it."""
    name, index = robot
    return name if find_game().parse_robot(name) == robot else f"{name}:{index}"


def _ticks(engine: Any, cars: int) -> Iterator[tuple[int, CarState, tuple[Any, ...]]]:
    """Drive to the end of the race; yield each car and its controls after each control tick."""
    while not engine.ended:
        engine.advance(1)
        for number in range(cars):
            yield number, engine.read(number), engine.controls(number)[:4]
