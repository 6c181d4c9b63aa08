"""The results that the game writes after a race."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from sb3_torcs.errors import GameFailed
from sb3_torcs.torcs.nodes import Node
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


def _results(process: GameProcess) -> Node:
    """
    Find the results of the race.

    :param process: of the game
    :return: the section of this race
    """
    race_name = process.race_name
    for file in (process.folder / "results" / Path(RACE_FILE).stem).glob("*.xml"):
        try:
            root = Node.read(file)
        except ValueError as error:
            raise GameFailed(
                f"the results that the game wrote are cut off ({error}); is there room in "
                f"'{process.folder.parent}'?"
            ) from error
        # The section has the name that the track's author gave, which is not needed.
        for section in root.sections():
            with suppress(LookupError):
                return section.find("Results", race_name)
    raise GameFailed(f"the game ended without results; it last said: {process.last_words()}")


def _practice_result(rows: Node, robot: str, index: int, car: str, laps: int) -> RobotResult:
    """
    Read the laps of a practice.

    :param rows: the section of this race
    :param robot: its name
    :param index: of the driver
    :param car: that it drove
    :param laps: that were asked for
    """
    ordered = sorted(rows.sections(), key=_position)
    client = rows.text("driver name") if robot == SCR_SERVER else ""
    driven = [Lap(row.number("time"), int(row.number("dammages"))) for row in ordered]
    return RobotResult(
        robot, index, car, driven,
        total_time=round(math.fsum(lap.time for lap in driven), 6),
        rank=1,
        damage=driven[-1].damage if driven else 0,
        out=len(driven) < laps,
        laps_completed=len(driven),
        best_lap=(ordered[-1].number("best lap time") or None) if ordered else None,
        client=client,
    )  # fmt: skip


def _race_results(
    rows: Node, cars: Mapping[tuple[str, int], str], laps: int, words: str
) -> list[RobotResult]:
    """
    Read the order of a race.

    :param rows: the section of this race
    :param cars: of the robots, by name and index
    :param laps: that were asked for
    :param words: the game's last, for an error
    """
    ranked = sorted(rows.child("Rank").sections(), key=_position)
    if len(ranked) != len(cars):  # the game goes on without a robot that it cannot load
        raise GameFailed(f"{len(ranked)} of {len(cars)} robots raced; the game last said: {words}")
    results = [_race_result(row, rank, cars) for rank, row in enumerate(ranked, 1)]
    last_seen = [r.total_time - row.number("penaltytime")
                 for r, row in zip(results, ranked, strict=True)]  # fmt: skip
    finished = [t for r, t in zip(results, last_seen, strict=True) if r.laps_completed == laps]
    # Lapped drivers end at the line after the winner. The race is over when one who has finished is
    # there again: who has not been there by then has not finished, wrecked or just slow.
    over = min(finished, default=math.inf)
    return [
        replace(result, out=result.laps_completed < laps and seen < over)
        for result, seen in zip(results, last_seen, strict=True)
    ]


def _race_result(row: Node, rank: int, cars: Mapping[tuple[str, int], str]) -> RobotResult:
    """
    Read one line of the order of a race.

    :param row: its section
    :param rank: its number
    :param cars: of the robots, by name and index
    """
    key = (row.text("module"), int(row.number("idx")))
    return RobotResult(
        *key, cars[key], laps=[], total_time=row.number("time"), rank=rank,
        damage=int(row.number("dammages")), out=False,
        laps_completed=max(int(row.number("laps")), 0),  # the game counts -1 before the start
        best_lap=row.number("best lap time") or None,
        client=row.text("name") if key[0] == SCR_SERVER else "",
    )  # fmt: skip


def _position(section: Node) -> int:
    """Read the number that a section goes by."""
    return int(section.name or 0)
