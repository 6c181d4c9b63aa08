"""Races run by the installed game itself, without a window: the reference for the engine.

The game gets a private folder for all that it writes, so nothing of the user's own
``~/.torcs`` is read or changed, and robots that learn begin anew each time.
"""

from __future__ import annotations

import math
import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree

from sb3_torcs.errors import GameFailed, GameIncomplete, GameTimeout, InvalidOption
from sb3_torcs.game import Game
from sb3_torcs.race_results import Lap, RobotResult

__all__ = ["SESSIONS", "game_environment", "missing_libraries", "run"]

Session = Literal["practice", "race"]
SESSIONS: Mapping[str, str] = {"practice": "practice.xml", "race": "quickrace.xml"}
"""The game's own descriptions of the sessions; all but track, drivers and laps stays as there."""

ENGINE_SETTINGS = "config/raceengine.xml"
RACE_FILE = "race.xml"  # names the folder of the results, too
LAST_LINES = 5  # of the game's words, for an error
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
    _check(robots, laps, session)
    if game.program is None:
        raise GameIncomplete(
            f"{game.libraries} has no torcs-bin, which runs races; type: `sb3-torcs install-torcs`"
        )
    track = game.find_track(track)
    cars = [game.find_robot(name, index).car for name, index in robots]
    if timeout is None:
        timeout = PATIENCE + PATIENCE_PER_LAP * laps * len(robots)
    with tempfile.TemporaryDirectory(prefix="sb3-torcs-game-") as name:
        folder = Path(name)
        race_name = _write_race(game, folder, track, robots, laps, session)
        words = _run_game(game, folder, timeout)
        rows = _results(folder, race_name, words)
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


def game_environment(game: Game, folder: Path) -> dict[str, str]:
    """
    Make the environment of a process of the game: its libraries, and nothing of the user's.

    :param game: the installation
    :param folder: that stands for the user's home
    :return: variables and their values
    """
    path = ":".join(str(part) for part in game.library_path)
    inherited = os.environ.get("LD_LIBRARY_PATH")
    return {
        "HOME": str(folder),
        "LC_ALL": "C",  # the game reads numbers by the locale
        "LD_LIBRARY_PATH": f"{path}:{inherited}" if inherited else path,
    }


def _check(robots: Sequence[tuple[str, int]], laps: int, session: str) -> None:
    """
    Refuse what the game would not do, or would do wrongly.

    :param robots: names and indices
    :param laps: to drive
    :param session: its name
    """
    if session not in SESSIONS:
        raise InvalidOption(f"session is {session!r}; expected {' or '.join(SESSIONS)}")
    if laps < 1:
        raise InvalidOption(f"laps is {laps}; expected at least 1")
    if session == "practice" and len(robots) != 1:
        raise InvalidOption(
            f"a practice is for one robot, {len(robots)} are named; choose session 'race'"
        )
    if not robots or len(set(robots)) < len(robots):
        named = ", ".join(f"{name}:{index}" for name, index in robots) or "none"
        raise InvalidOption(f"robots are {named}; expected at least one, none of them twice")


def _write_race(
    game: Game,
    folder: Path,
    track: str,
    robots: Sequence[tuple[str, int]],
    laps: int,
    session: str,
) -> str:
    """
    Write what the game reads: its own settings, and the description of the race.

    :param game: the installation
    :param folder: private to the game
    :param track: ``category/name``
    :param robots: names and indices
    :param laps: to drive
    :param session: its name
    :return: the name that the race goes by in the results
    """
    settings = folder / ENGINE_SETTINGS
    settings.parent.mkdir()
    _needed(game, ENGINE_SETTINGS)
    shutil.copyfile(game.data / ENGINE_SETTINGS, settings)
    template = f"config/raceman/{SESSIONS[session]}"
    _needed(game, template)
    try:
        root = ElementTree.parse(game.data / template).getroot()
        race_name = _text(_section(root, "Races", "1"), "name")
        _set(_section(root, race_name), "attnum", "laps", str(laps))
        category, _, name = track.rpartition("/")
        place = _list(_section(root, "Tracks"), 1)[0]
        _set(place, "attstr", "name", name)
        _set(place, "attstr", "category", category)
        entries = _list(_section(root, "Drivers"), len(robots))
    except (ElementTree.ParseError, LookupError) as error:
        raise GameIncomplete(
            f"{game.data / template} is broken ({error}); type: `sb3-torcs install-torcs`"
        ) from error
    for entry, (robot, index) in zip(entries, robots, strict=True):
        _set(entry, "attnum", "idx", str(index))
        _set(entry, "attstr", "module", robot)
    ElementTree.ElementTree(root).write(folder / RACE_FILE, encoding="UTF-8", xml_declaration=True)
    return race_name


def _needed(game: Game, file: str) -> None:
    """
    Make sure that a file of the game's data is there.

    :param game: the installation
    :param file: seen from its data
    """
    if not (game.data / file).is_file():
        raise GameIncomplete(f"there is no {game.data / file}; type: `sb3-torcs install-torcs`")


def _run_game(game: Game, folder: Path, timeout: float) -> str:
    """
    Run the game to its end.

    :param game: the installation
    :param folder: private to the game, with the race in it
    :param timeout: after which it is killed [s]
    :return: its last words
    """
    call = [str(game.program), "-l", str(folder), "-L", str(game.libraries)]
    call += ["-D", str(game.data), "-r", str(folder / RACE_FILE)]
    with (folder / "words").open("w+b") as words:
        try:
            # The game opens its data relative to where it runs.
            done = subprocess.run(
                call, cwd=game.data, env=game_environment(game, folder), timeout=timeout,
                stdin=subprocess.DEVNULL, stdout=words, stderr=subprocess.STDOUT, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired as error:
            raise GameTimeout(
                f"the game did not end the race within {timeout:g} s and was stopped; "
                f"it last said: {_last_words(words.name)}"
            ) from error
        except OSError as error:
            raise GameFailed(f"{game.program} does not run: {error.strerror}") from error
    last = _last_words(words.name)
    if done.returncode != 0:
        how = f"exit status {done.returncode}"
        if done.returncode < 0:
            how = signal.Signals(-done.returncode).name
        raise GameFailed(f"the game ended with {how}; it last said: {last}")
    return last


def _last_words(file: str) -> str:
    """
    Read the end of what the game printed.

    :param file: that it printed to
    :return: the last lines, as one
    """
    with Path(file).open("rb") as words:
        words.seek(max(0, Path(file).stat().st_size - 4096))
        lines = words.read().decode(errors="replace").splitlines()
    return " / ".join([line.strip() for line in lines if line.strip()][-LAST_LINES:]) or "nothing"


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


def _section(section: ElementTree.Element, *names: str) -> ElementTree.Element:
    """
    Find a section inside another.

    :param section: around it
    :param names: from the outside in
    :raises LookupError: naming what is not there
    """
    for name in names:
        inner = next((s for s in section.findall("section") if s.get("name") == name), None)
        if inner is None:
            raise LookupError(f"no section '{name}'")
        section = inner
    return section


def _list(section: ElementTree.Element, entries: int) -> list[ElementTree.Element]:
    """
    Give a section numbered entries in place of those it has.

    :param section: to change
    :param entries: how many
    :return: the entries
    """
    for old in section.findall("section"):
        section.remove(old)
    return [
        ElementTree.SubElement(section, "section", name=str(number))
        for number in range(1, entries + 1)
    ]


def _set(section: ElementTree.Element, tag: str, name: str, value: str) -> None:
    """
    Set a value.

    :param section: to change
    :param tag: ``attnum`` or ``attstr``
    :param name: of the value
    :param value: as text
    """
    found = next((a for a in section.findall(tag) if a.get("name") == name), None)
    if found is None:
        found = ElementTree.SubElement(section, tag, name=name)
    found.set("val", value)


def _text(section: ElementTree.Element, name: str) -> str:
    """
    Read a value.

    :param section: that holds it
    :param name: of the value
    :raises LookupError: if it is not there
    """
    for attribute in section:
        if attribute.tag in ("attstr", "attnum") and attribute.get("name") == name:
            return attribute.get("val", "")
    raise LookupError(f"no value '{name}' in section '{section.get('name')}'")


def _number(section: ElementTree.Element, name: str) -> float:
    """
    Read a number.

    :param section: that holds it
    :param name: of the value
    :return: the number; 0, as the game has it, if it is not there
    """
    try:
        return float(_text(section, name))
    except LookupError:
        return 0.0
