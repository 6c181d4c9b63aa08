"""Races run by the installed game itself, without a window: the reference for the engine."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from sb3_torcs.game import Game
from sb3_torcs.game_process import GameProcess, game_environment
from sb3_torcs.game_results import read_results
from sb3_torcs.race_file import RaceSetup, Session
from sb3_torcs.race_results import RobotResult

__all__ = ["missing_libraries", "run"]

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
    with GameProcess(game, race) as process:
        process.wait(timeout)
        return read_results(process, race, cars)


def missing_libraries(game: Game) -> list[str]:
    """
    Ask the dynamic linker which libraries the game's program would not find.

    :param game: the installation; the program is not started
    :return: their names
    """
    if game.program is None:
        return []
    with tempfile.TemporaryDirectory(prefix="sb3-torcs-game-") as folder:
        environment = {**game_environment(game, Path(folder)), "LD_TRACE_LOADED_OBJECTS": "1"}
        # The arguments are for linkers that do not know this variable: the game ends at once.
        call = [str(game.program), "-l", folder, "-r", "none"]
        done = subprocess.run(
            call, cwd=folder, env=environment, timeout=PATIENCE, check=False,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        )  # fmt: skip
    lines = done.stdout.decode(errors="replace").splitlines()
    return [line.split()[0] for line in lines if line.endswith("not found")]
