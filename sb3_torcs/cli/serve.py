"""``sb3-torcs serve``: the game as an SCR server, for clients of every language."""

from __future__ import annotations

import argparse
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from sb3_torcs.car import DEFAULT_CAR
from sb3_torcs.cli.common import READER_LEFT, drop_output, parsed_robots, positive
from sb3_torcs.cli.results import show_results

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sb3_torcs.torcs.process import GameProcess
    from sb3_torcs.torcs.race_setup import RaceSetup

__all__ = ["add_parser", "run"]

DEFAULT_DEADLINE = 10.0  # [ms] as in the SCR server
SHORTEST_DEADLINE = 0.001  # [ms] the server counts in microseconds
LONGEST_DEADLINE = 3_600_000.0  # [ms]
REPORT = "scr_server"  # prefix of the lines that our drivers print
OPTIONS = {
    "no_fuel": ("nofuel", "no car uses fuel"),
    "no_damage": ("nodamage", "no car takes damage; clients are told what it would be"),
    "no_lap_limit": ("nolaptime", "nobody is taken out of the race for a slow lap"),
    "noisy": ("noisy", "sensors err: range finders by 10 %%, opponents by 2 %%, focus by 1 %%"),
}
"""Of the command, what the game's drivers call them, and what they do."""

DESCRIPTION = """\
Start the installed game as a server of the SCR protocol (arXiv:1304.1672). Each client drives one
car over a UDP port of its own; robots of the game start behind the clients. The race begins when
every client has identified itself. The command ends with the race and leaves no files or processes
behind. Ctrl-C and SIGTERM end the race for all clients and print the results so far.

A client has 10 ms of real time for an answer, or as much as --deadline says. If its answer is late,
the car repeats the last action. With --wait the game waits for every answer, so that the drive
does not depend on the client's speed.
"""


def add_parser(subparsers: Any) -> None:
    """
    :param subparsers: of the command
    """
    parser = subparsers.add_parser(
        "serve",
        help="start the game as an SCR server",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--track", default="aalborg", metavar="T", help="default: aalborg")
    add("--drivers", type=positive, default=1, metavar="N", help="clients, 1 to 10; default: 1")
    add("--robots", metavar="NAME:I,…", help="robots of the game, which start behind the clients")
    add("--car", default=DEFAULT_CAR, metavar="C",
        help=f"car of the clients; default: {DEFAULT_CAR}")  # fmt: skip
    add("--laps", type=positive, default=20, metavar="L", help="default: 20")
    add("--host", default="127.0.0.1", metavar="H",
        help="address; default: 127.0.0.1; 0.0.0.0 accepts other machines")  # fmt: skip
    add("--port", type=positive, default=3001, metavar="P",
        help="UDP port of the first client; the others follow; default: 3001")  # fmt: skip
    time = parser.add_mutually_exclusive_group()
    time.add_argument("--wait", action="store_true", help="wait for every answer")
    time.add_argument("--deadline", type=float, default=DEFAULT_DEADLINE, metavar="MS",
                      help="ms for an answer; default: 10")  # fmt: skip
    for option, (_, effect) in OPTIONS.items():
        add(f"--{option.replace('_', '-')}", action="store_true", help=effect)
    add("--window", action="store_true", help="show the game's 3D view")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    :param args: from the command line
    :return: the exit status
    """
    from sb3_torcs.errors import InvalidOption
    from sb3_torcs.scr.server import open_ports, start_server
    from sb3_torcs.torcs.display import find_display
    from sb3_torcs.torcs.installation import find_game
    from sb3_torcs.torcs.race_setup import SCR_DRIVERS, SCR_SERVER, RaceSetup, session_for
    from sb3_torcs.torcs.results import read_results
    from sb3_torcs.torcs.window import Window

    if args.drivers > SCR_DRIVERS:
        raise InvalidOption(f"--drivers is {args.drivers}; expected 1 to {SCR_DRIVERS}")
    if not SHORTEST_DEADLINE <= args.deadline <= LONGEST_DEADLINE:
        raise InvalidOption(
            f"--deadline is {args.deadline:g} ms; expected {SHORTEST_DEADLINE:g} to "
            f"{LONGEST_DEADLINE:g}, or --wait"
        )
    game = find_game()
    robots = parsed_robots(args.robots, game)
    drivers = [(SCR_SERVER, number) for number in range(args.drivers)] + robots
    race = RaceSetup(args.track, drivers, args.laps, session_for(drivers), args.car)
    cars = race.cars(game)
    deadline = None if args.wait else args.deadline / 1000.0
    window = Window(display=find_display("leave --window out")) if args.window else None
    options = [name for option, (name, _) in OPTIONS.items() if getattr(args, option)]
    sockets = open_ports(args.drivers, args.port, args.host)
    try:
        process = start_server(
            game, race, sockets, deadline=deadline, options=options, window=window
        )
    finally:
        for bound in sockets:
            bound.close()
    echo = Echo()
    with process:
        echo.say(_announcement(args))
        try:
            process.follow(echo.report)
        except (KeyboardInterrupt, SystemExit):
            _interrupt(process, race, cars, echo)
            raise
        show_results(read_results(process, race, cars), drivers[0], str(args.track))
    return READER_LEFT if echo.reader_left else 0


def _announcement(args: argparse.Namespace) -> str:
    """Say at which addresses clients may connect."""
    last = args.port + args.drivers - 1
    ports = f"port {args.port}" if last == args.port else f"ports {args.port} to {last}"
    time = "the game waits for every answer" if args.wait else f"{args.deadline:g} ms per answer"
    return f"{args.track}: waiting for SCR clients at {args.host}, UDP {ports}; {time}"


class Echo:
    """Prints lines at once. Who reads them may leave: the race goes on for its clients."""

    reader_left = False

    def say(self, line: str) -> None:
        """
        :param line: to be printed
        """
        try:
            print(line, flush=True)
        except BrokenPipeError:
            self.reader_left = True
            drop_output()

    def report(self, line: str) -> None:
        """
        Print what our drivers say.

        :param line: of the game
        """
        if line.startswith(REPORT):
            self.say(line)


def _interrupt(process: GameProcess, race: RaceSetup, cars: Sequence[str], echo: Echo) -> None:
    """
    End the race for all clients, and print the results.

    :param process: of the game
    :param race: who races where
    :param cars: of the drivers, in their order
    :param echo: of what the drivers say
    """
    from sb3_torcs.errors import GameFailed
    from sb3_torcs.torcs.results import read_results

    process.end_race()
    # A game that is loading or paused writes no results; a closed terminal cannot show them.
    with suppress(GameFailed, OSError):
        process.follow(echo.report)
        # In a race that was ended early, nobody is out for not having finished it.
        results = [replace(r, out=False) for r in read_results(process, race, cars)]
        print("the race was ended early:")
        show_results(results, race.drivers[0], str(race.track))
