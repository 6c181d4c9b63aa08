"""What the game writes down after a race."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

from sb3_torcs.errors import GameFailed
from sb3_torcs.torcs.process import GameProcess
from sb3_torcs.torcs.race_results import Lap, RobotResult
from sb3_torcs.torcs.race_setup import RACE_FILE, SCR_SERVER, RaceSetup

__all__ = ["read_results"]


def read_results(process: GameProcess, race: RaceSetup, cars: Sequence[str]) -> list[RobotResult]:
    """
    Read the results of a race that has ended by itself.

    :param process: of the game
    :param race: who raced where
    :param cars: of the drivers, in their order
    :return: one result per driver, the winner first
    :raises GameFailed: if there are none
    """
    rows = _results(process)
    if race.session == "practice":
        return [_practice_result(rows, *race.drivers[0], cars[0], race.laps)]
    by_driver = dict(zip(race.drivers, cars, strict=True))
    return _race_results(rows, by_driver, race.laps, process.last_words())


def _results(process: GameProcess) -> ElementTree.Element:
    """
    Find the results of the race.

    :param process: of the game
    :return: the section of this race
    """
    race_name = process.race_name
    for file in (process.folder / "results" / Path(RACE_FILE).stem).glob("*.xml"):
        try:
            root = ElementTree.parse(file).getroot()
        except ElementTree.ParseError as error:
            raise GameFailed(
                f"the results that the game wrote are cut off ({error}); is there room in "
                f"'{process.folder.parent}'?"
            ) from error
        # The section of the track goes by the name that its author gave it: any will do.
        for section in root.findall("section"):
            found = section.find(f"section[@name='Results']/section[@name='{race_name}']")
            if found is not None:
                return found
    raise GameFailed(f"the game ended without results; it last said: {process.last_words()}")


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
    client = _text(rows, "driver name") if robot == SCR_SERVER else ""
    driven = [Lap(_number(row, "time"), int(_number(row, "dammages"))) for row in ordered]
    return RobotResult(
        robot, index, car, driven,
        total_time=round(math.fsum(lap.time for lap in driven), 6),
        rank=1,
        damage=driven[-1].damage if driven else 0,
        out=len(driven) < laps,
        laps_completed=len(driven),
        best_lap=(_number(ordered[-1], "best lap time") or None) if ordered else None,
        client=client,
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
        client=_text(row, "name") if key[0] == SCR_SERVER else "",
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
