"""Races run by the installed game itself, without a window: the reference for the engine."""

from __future__ import annotations

import math
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

from sb3_torcs.errors import GameFailed
from sb3_torcs.game import Game
from sb3_torcs.game_process import GameProcess, game_environment
from sb3_torcs.race_file import RACE_FILE, RaceSetup, Session
from sb3_torcs.race_results import Lap, RobotResult

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
    cars = [game.find_robot(name, index).car for name, index in robots]
    if timeout is None:
        timeout = PATIENCE + PATIENCE_PER_LAP * laps * len(robots)
    with GameProcess(game, race) as process:
        process.wait(timeout)
        words = process.last_words()
        rows = _results(process.folder, process.race_name, words)
    if session == "practice":
        return [_practice_result(rows, *robots[0], cars[0], laps)]
    return _race_results(rows, dict(zip(robots, cars, strict=True)), laps, words)


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


def _results(folder: Path, race_name: str, words: str) -> ElementTree.Element:
    """
    Find the results of the race.

    :param folder: private to the game
    :param race_name: that the race goes by
    :param words: the game's last, for an error
    :return: the section of this race
    """
    for file in (folder / "results" / Path(RACE_FILE).stem).glob("*.xml"):
        # The section of the track goes by the name that its author gave it: any will do.
        for section in ElementTree.parse(file).getroot().findall("section"):
            found = section.find(f"section[@name='Results']/section[@name='{race_name}']")
            if found is not None:
                return found
    raise GameFailed(f"the game ended without results; it last said: {words}")


def _practice_result(
    rows: ElementTree.Element, robot: str, index: int, car: str, laps: int
) -> RobotResult:
    """
    Read the laps of a practice.

    :param rows: the section of this race
    :param robot: its name
    :param index: of the driver
    :param car: that it drove
    :param laps: that were asked for
    """
    ordered = sorted(rows.findall("section"), key=_position)
    driven = [Lap(_number(row, "time"), int(_number(row, "dammages"))) for row in ordered]
    return RobotResult(
        robot, index, car, driven,
        total_time=round(math.fsum(lap.time for lap in driven), 6),
        rank=1,
        damage=driven[-1].damage if driven else 0,
        out=len(driven) < laps,
        laps_completed=len(driven),
        best_lap=(_number(ordered[-1], "best lap time") or None) if ordered else None,
    )  # fmt: skip


def _race_results(
    rows: ElementTree.Element, cars: Mapping[tuple[str, int], str], laps: int, words: str
) -> list[RobotResult]:
    """
    Read the order of a race.

    :param rows: the section of this race
    :param cars: of the robots, by name and index
    :param laps: that were asked for
    :param words: the game's last, for an error
    """
    ranks = next((s for s in rows.findall("section") if s.get("name") == "Rank"), None)
    ranked = [] if ranks is None else sorted(ranks.findall("section"), key=_position)
    if len(ranked) != len(cars):  # the game goes on without a robot that it cannot load
        raise GameFailed(f"{len(ranked)} of {len(cars)} robots raced; the game last said: {words}")
    results = [_race_result(row, rank, cars) for rank, row in enumerate(ranked, 1)]
    last_seen = [r.total_time - _number(row, "penaltytime")
                 for r, row in zip(results, ranked, strict=True)]  # fmt: skip
    finished = [t for r, t in zip(results, last_seen, strict=True) if r.laps_completed == laps]
    # Who was lapped ends at the line after the winner; who is out never came there.
    over = min(finished, default=math.inf)
    return [
        replace(result, out=result.laps_completed < laps and seen < over)
        for result, seen in zip(results, last_seen, strict=True)
    ]


def _race_result(
    row: ElementTree.Element, rank: int, cars: Mapping[tuple[str, int], str]
) -> RobotResult:
    """
    Read one line of the order of a race.

    :param row: its section
    :param rank: its number
    :param cars: of the robots, by name and index
    """
    key = (_text(row, "module"), int(_number(row, "idx")))
    return RobotResult(
        *key, cars[key], laps=[], total_time=_number(row, "time"), rank=rank,
        damage=int(_number(row, "dammages")), out=False,
        laps_completed=int(_number(row, "laps")), best_lap=_number(row, "best lap time") or None,
    )  # fmt: skip


def _position(section: ElementTree.Element) -> int:
    """
    Read the number that a section goes by.

    :param section: of a list
    """
    return int(section.get("name", "0"))


def _text(section: ElementTree.Element, name: str) -> str:
    """
    Read a value.

    :param section: that holds it
    :param name: of the value
    :return: the text; empty if it is not there
    """
    values = (a.get("val", "") for a in section.iterfind("*[@val]") if a.get("name") == name)
    return next(values, "")


def _number(section: ElementTree.Element, name: str) -> float:
    """
    Read a number.

    :param section: that holds it
    :param name: of the value
    :return: the number; 0, as the game has it, if it is not there
    """
    return float(_text(section, name) or 0.0)
