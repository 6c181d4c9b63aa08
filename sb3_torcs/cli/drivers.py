"""``sb3-torcs drivers``: list the drivers that every verb knows by name."""

from __future__ import annotations

import argparse
from typing import Any

from sb3_torcs.cli.common import print_json, table

__all__ = ["add_parser", "run"]

HEADERS = ("name", "kind", "does")

DESCRIPTION = """\
List the drivers that the verbs know by name: the shipped agents and ghosts, the robots of the
installed game, and the scripted driver. Verbs that take a driver also take the .zip of a saved
model, its run's folder, and the .npz of a ghost.

A robot has a driver for each of several cars: inferno is that of car1-trb1, inferno:3 another.
"""


def add_parser(subparsers: Any) -> None:
    """
    :param subparsers: of the command
    """
    parser = subparsers.add_parser(
        "drivers",
        help="list agents, robots and ghosts",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--json", action="store_true", help="print a JSON list and nothing else")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    :param args: from the command line
    :return: the exit status
    """
    from sb3_torcs.agents.drivers import list_drivers

    rows = list_drivers()
    if args.json:
        print_json([row._asdict() for row in rows])
    else:
        print(table(HEADERS, rows))
    return 0
