"""``sb3-torcs robots``: laps of the game's robots, in the engine or in the game itself."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_torcs.car import DEFAULT_CAR
from sb3_torcs.cli.common import (
    natural,
    parsed_robots,
    positive,
    print_json,
    quiet_output,
    table,
)
from sb3_torcs.cli.results import results_as_json, show_results
from sb3_torcs.files import writable_file

if TYPE_CHECKING:
    from sb3_torcs.errors import OutputNotWritable
    from sb3_torcs.torcs.installation import Game
    from sb3_torcs.torcs.race_results import RobotResult

__all__ = ["add_parser", "run"]

ROBOT_HEADERS = ("robot", "index", "name", "car")

DRIVING = ("index", "track", "laps", "rivals", "game", "telemetry")
"""Options of a drive, which are refused where no robot is named."""

DESCRIPTION = """\
List the installed robots. With NAME, let one of them drive: alone in a practice session, or in a
race against the robots that --with names.

The engine runs the race in this process. With --game, the game's text mode runs it instead, for
comparison.
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
    add("name", nargs="?", metavar="NAME", help="the robot, e.g. inferno")
    add("--index", type=natural, metavar="I",
        help=f"which of the robot's drivers; default: that of {DEFAULT_CAR}")  # fmt: skip
    add("--track", metavar="T", help="the track; default: aalborg")
    add("--laps", type=positive, metavar="N", help="laps to drive; default: 3")
    add("--with", dest="rivals", metavar="NAME:I,…",
        help="robots to race against; they start behind")  # fmt: skip
    add("--game", action="store_true", help="run the race in the game's text mode")
    add(
        "--telemetry",
        metavar="FILE",
        help="write the drive to a .parquet or a .csv; not with --game",
    )
    add("--json", action="store_true", help="print JSON and nothing else")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    :param args: from the command line
    :return: the exit status
    """
    from sb3_torcs.errors import InvalidOption
    from sb3_torcs.torcs.installation import find_game
    from sb3_torcs.torcs.track_names import find_track

    game = find_game()
    if args.name is None:
        _check_only_listed(args)
        _list(game, args.json)
        return 0
    if args.index is not None and ":" in args.name:
        raise InvalidOption(f"'{args.name}' has an index already; leave out --index {args.index}")
    if args.telemetry is not None and args.game:
        raise InvalidOption("--telemetry is written by the engine only; leave out --game")
    telemetry = None
    if args.telemetry is not None:
        telemetry = writable_file(args.telemetry, (".parquet", ".csv"))
    name = args.name if args.index is None else f"{args.name}:{args.index}"
    robots = [game.parse_robot(name), *parsed_robots(args.rivals, game)]
    args.track = "aalborg" if args.track is None else args.track
    args.laps = 3 if args.laps is None else args.laps
    file = find_track(args.track, game)
    track = args.track if file.source == "file" else file.name
    with quiet_output(args.json):
        results, unwritten = _drive(game, robots, track, args, telemetry)
    if args.json:
        print_json(results_as_json(results, robots[0], track))
    else:
        show_results(results, robots[0], track)
    if unwritten is not None:
        raise unwritten
    if telemetry is not None and not args.json:
        print(f"telemetry: {telemetry}")
    return 0


def _check_only_listed(args: argparse.Namespace) -> None:
    """Refuse options of a drive where no robot is named: robots are only listed."""
    from sb3_torcs.errors import InvalidOption

    for name in DRIVING:
        if getattr(args, name) not in (None, False):
            option = f"--{'with' if name == 'rivals' else name}"
            raise InvalidOption(f"{option} is for a robot that drives; name one: robots inferno")


def _list(game: Game, as_json: bool) -> None:
    """
    Show the robots whose cars are installed, too: some packages leave cars out.

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
) -> tuple[list[RobotResult], OutputNotWritable | None]:
    """
    Let the robots drive.

    :param game: the installation
    :param robots: names and indices
    :param track: ``category/name``, or the path of a file
    :param args: from the command line
    :param telemetry: file for the drive itself
    :return: one result per robot, the winner first; and why there is no telemetry, if that failed
    """
    from rich.console import Console

    from sb3_torcs.torcs.race_setup import session_for

    session = session_for(robots)
    with Console(stderr=True).status(f"{len(robots)} on {track}, {args.laps} laps"):
        if args.game:
            from sb3_torcs.races.text_mode import run as run_game

            return run_game(game, track, robots, args.laps, session), None
        from sb3_torcs.agents.robots import race_to_its_end

        return race_to_its_end(robots, track, args.laps, session, telemetry)
