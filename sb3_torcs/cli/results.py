"""Results of races, as text."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sb3_torcs.cli.common import table

if TYPE_CHECKING:
    from sb3_torcs.races.protocol import Race
    from sb3_torcs.torcs.race_results import RobotResult

__all__ = ["UNKNOWN", "show_results", "show_standings"]

UNKNOWN = "-"  # in tables

LAP_HEADERS = ("lap", "time s", "damage")
RACE_HEADERS = ("rank", "driver", "car", "laps", "total s", "best lap s", "damage", "out")
STANDINGS = ("place", "driver", "from", "laps", "time s", "best lap s", "damage", "contacts")


def _own(results: list[RobotResult], robot: tuple[str, int]) -> RobotResult:
    """Find the result of one robot."""
    return next(result for result in results if (result.robot, result.index) == robot)


def show_results(results: list[RobotResult], robot: tuple[str, int], track: str) -> None:
    """
    Print tables.

    :param results: of all
    :param robot: that was named
    :param track: ``category/name``, or the path of a file
    """
    if len(results) > 1:
        print(f"race on {_short(track)}")
        print(table(RACE_HEADERS, [_race_row(result) for result in results]))
        return
    own = _own(results, robot)
    print(f"{own.driver}, {own.car}, {_short(track)}")
    rows = [(str(n), f"{lap.time:.3f}", str(lap.damage)) for n, lap in enumerate(own.laps, 1)]
    print(table(LAP_HEADERS, rows) if rows else "no whole lap")
    best = "none without a fault" if own.best_lap is None else f"{own.best_lap:.3f} s"
    print(f"best lap: {best}{'; out' if own.out else ''}")


def show_standings(race: Race) -> None:
    """
    Print how a race of the engine ended.

    :param race: that is over
    """
    print(table(STANDINGS, [
        (
            "out" if s.out else str(s.place), s.driver, str(s.grid_slot), str(s.laps),
            f"{s.time:.3f}" if s.laps else UNKNOWN,
            UNKNOWN if s.best_lap is None else f"{s.best_lap:.3f}",
            f"{s.damage:.0f}", str(s.contacts),
        )
        for s in race.standings
    ]))  # fmt: skip


def _race_row(result: RobotResult) -> list[str]:
    best = "-" if result.best_lap is None else f"{result.best_lap:.3f}"
    return [
        str(result.rank),
        result.driver,
        result.car,
        str(result.laps_completed),
        f"{result.total_time:.3f}",
        best,
        str(result.damage),
        "yes" if result.out else "no",
    ]


def _short(track: str) -> str:
    return track.rpartition("/")[2].removesuffix(".xml")
