"""``sb3-torcs robots``: what the game's own robots drive, by the engine or by the game itself."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sb3_torcs.cli.common import natural, positive, print_json, quiet_output, table, writable_file

if TYPE_CHECKING:
    from sb3_torcs.game import Game
    from sb3_torcs.race_results import RobotResult

__all__ = ["add_parser", "run"]

ROBOT_HEADERS = ("robot", "index", "name", "car")
LAP_HEADERS = ("lap", "time s", "damage")
RACE_HEADERS = ("rank", "robot", "index", "car", "laps", "total s", "best lap s", "damage", "out")

DESCRIPTION = """\
Let a robot of the game drive, alone, in the session that the game calls practice; or, with --with,
against others in a race. Without NAME: list the robots that are installed.

The engine drives it in this process; --game lets the game's own text mode do so, for comparison.
"""


def add_parser(subparsers: Any) -> None:
    """
    :param subparsers: of the command
    """
    parser = subparsers.add_parser(
        "robots",
        help="list the game's robots, or let them drive",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("name", nargs="?", metavar="NAME", help="e.g. inferno")
    add("--index", type=natural, metavar="I",
        help="which of the robot's drivers; default: that of car1-trb1")  # fmt: skip
    add("--track", default="aalborg", metavar="T", help="default: aalborg")
    add("--laps", type=positive, default=3, metavar="N", help="default: 3")
    add("--with", dest="rivals", metavar="NAME:I,…",
        help="race against these, who start behind")  # fmt: skip
    add("--game", action="store_true", help="by the game's text mode, not by the engine")
    add("--telemetry", metavar="FILE", help="write the drive itself down; only by the engine")
    add("--json", action="store_true", help="print JSON and nothing else")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    :param args: from the command line
    :return: the exit status
    """
    from sb3_torcs.errors import InvalidOption
    from sb3_torcs.game import find_game

    game = find_game()
    if args.name is None:
        _list(game, args.json)
        return 0
    if args.telemetry is not None and args.game:
        raise InvalidOption("--telemetry is written by the engine only; leave out --game")
    telemetry = None
    if args.telemetry is not None:
        telemetry = writable_file(args.telemetry, (Path(args.telemetry).suffix.lower(),))
    name = args.name if args.index is None else f"{args.name}:{args.index}"
    rivals = [] if args.rivals is None else args.rivals.split(",")
    robots = [game.parse_robot(word) for word in (name, *rivals)]
    is_file = args.track.lower().endswith(".xml") and not args.game
    track = args.track if is_file else game.find_track(args.track)
    with quiet_output(args.json):
        results = _drive(game, robots, track, args, telemetry)
    if args.json:
        print_json(_as_json(results, robots[0], track))
        return 0
    _show(results, robots[0], track)
    if telemetry is not None:
        print(f"telemetry: {telemetry}")
    return 0


def _list(game: Game, as_json: bool) -> None:
    """
    Show the robots that are installed and whose cars are: some packages leave cars out.

    :param game: the installation
    :param as_json: whether as JSON
    """
    cars = game.cars()
    rows = [
        (name, entry)
        for name, entries in game.robots().items()
        for entry in entries
        if entry.car in cars
    ]
    if as_json:
        print_json([{"robot": name, **asdict(entry)} for name, entry in rows])
        return
    cells = [(name, str(entry.index), entry.name, entry.car) for name, entry in rows]
    print(table(ROBOT_HEADERS, cells))


def _drive(
    game: Game,
    robots: list[tuple[str, int]],
    track: str,
    args: argparse.Namespace,
    telemetry: Path | None,
) -> list[RobotResult]:
    """
    Let them drive.

    :param game: the installation
    :param robots: names and indices
    :param track: ``category/name``, or the path of a file
    :param args: from the command line
    :param telemetry: file for the drive itself
    :return: one result per robot, the winner first
    """
    from rich.console import Console

    session: Literal["practice", "race"] = "race" if len(robots) > 1 else "practice"
    with Console(stderr=True).status(f"{len(robots)} on {track}, {args.laps} laps"):
        if args.game:
            from sb3_torcs.text_mode import run as run_game

            return run_game(game, track, robots, args.laps, session)
        from sb3_torcs.robots import race

        return race(robots, track, args.laps, session=session, telemetry=telemetry)


def _own(results: list[RobotResult], robot: tuple[str, int]) -> RobotResult:
    """
    Find the result of one robot.

    :param results: of all
    :param robot: name and index
    """
    return next(result for result in results if (result.robot, result.index) == robot)


def _as_json(results: list[RobotResult], robot: tuple[str, int], track: str) -> dict[str, Any]:
    """
    Make the JSON object: the named robot's drive, and in a race everybody's.

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


def _show(results: list[RobotResult], robot: tuple[str, int], track: str) -> None:
    """
    Print tables for people.

    :param results: of all
    :param robot: that was named
    :param track: ``category/name``, or the path of a file
    """
    if len(results) > 1:
        print(f"race on {_short(track)}")
        print(table(RACE_HEADERS, [_race_row(result) for result in results]))
        return
    own = _own(results, robot)
    print(f"{own.robot} {own.index}, {own.car}, {_short(track)}")
    rows = [(str(n), f"{lap.time:.3f}", str(lap.damage)) for n, lap in enumerate(own.laps, 1)]
    print(table(LAP_HEADERS, rows) if rows else "no whole lap")
    best = "none without a fault" if own.best_lap is None else f"{own.best_lap:.3f} s"
    print(f"best lap: {best}{'; out' if own.out else ''}")


def _race_row(result: RobotResult) -> list[str]:
    best = "-" if result.best_lap is None else f"{result.best_lap:.3f}"
    return [
        str(result.rank),
        result.robot,
        str(result.index),
        result.car,
        str(result.laps_completed),
        f"{result.total_time:.3f}",
        best,
        str(result.damage),
        "yes" if result.out else "no",
    ]


def _short(track: str) -> str:
    return track.rpartition("/")[2].removesuffix(".xml")
