"""Races run by the installed game itself, without a window: the reference for the engine."""

from __future__ import annotations

from collections.abc import Sequence

from sb3_torcs.torcs.installation import Game
from sb3_torcs.torcs.process import GameProcess
from sb3_torcs.torcs.race_results import RobotResult
from sb3_torcs.torcs.race_setup import RaceSetup, Session
from sb3_torcs.torcs.results import read_results
from sb3_torcs.tracks.trial import check_track

__all__ = ["run"]

PATIENCE = 30.0  # [s] to start the game on a busy machine
PATIENCE_PER_LAP = 5.0  # [s] per robot; it takes 0.1 s when nothing else runs


def run(
    game: Game,
    track: str,
    robots: Sequence[tuple[str, int]],
    laps: int = 3,
    session: Session = "practice",
    timeout: float | None = None,
) -> list[RobotResult]:
    """
    Run a race by the game's text mode.

    The game keeps six significant digits: times below 1000 s are exact to the millisecond.

    :param game: the installation
    :param track: ``"aalborg"`` or ``"road/aalborg"``
    :param robots: names and indices, the first one at the head of the grid
    :param laps: to drive
    :param session: ``"practice"``, for one robot, lap by lap; or ``"race"``
    :param timeout: after which the game is ended [s]; ``None`` for what a slow machine needs
    :return: one result per robot, the winner first
    :raises InvalidOption: if the session cannot be had
    :raises TrackNotFound: if the game has no such track
    :raises UnknownRobot: if the game has no such robot
    :raises UnknownCar: if the game has not the car of a robot
    :raises GameIncomplete: if the game lacks its program, or a file that a race needs
    :raises GameFailed: if the game ends without results
    :raises GameTimeout: if the game does not end in time
    """
    race = RaceSetup(track, robots, laps, session)
    cars = race.cars(game)
    if timeout is None:
        timeout = PATIENCE + PATIENCE_PER_LAP * laps * len(robots)
    with GameProcess(game, race, check=check_track) as process:
        process.wait(timeout)
        return read_results(process, race, cars)
