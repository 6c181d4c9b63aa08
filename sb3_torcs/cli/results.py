"""Results of races, as text and as JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sb3_torcs.cli.common import table

if TYPE_CHECKING:
    from sb3_torcs.torcs.race_results import RobotResult

__all__ = ["results_as_json", "show_results"]

LAP_HEADERS = ("lap", "time s", "damage")
RACE_HEADERS = ("rank", "driver", "car", "laps", "total s", "best lap s", "damage", "out")


def _own(results: list[RobotResult], robot: tuple[str, int]) -> RobotResult:
    """Find the result of one robot."""
    return next(result for result in results if (result.robot, result.index) == robot)


def results_as_json(
    results: list[RobotResult], robot: tuple[str, int], track: str
) -> dict[str, Any]:
    """
    Make the JSON object: the named robot's drive, and in a race all drivers'.

    :param results: of all
    :param robot: that was named
    :param track: ``category/name``, or the path of a file
    """
    own = _own(results, robot)
    laps = [{"time": lap.time, "damage": lap.damage} for lap in own.laps]
    value: dict[str, Any] = {"robot": own.robot, "index": own.index, "track": _short(track)}
    value |= {"car": own.car, "laps": laps}
    if len(results) > 1:
        value["race"] = [
            {
                "rank": result.rank, "robot": result.robot, "index": result.index,
                "car": result.car, "laps_completed": result.laps_completed,
                "total_time": result.total_time, "best_lap": result.best_lap,
                "damage": result.damage, "out": result.out,
                "laps": [{"time": lap.time, "damage": lap.damage} for lap in result.laps],
            }
            for result in results
        ]  # fmt: skip
    return value


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
