"""``sb3-torcs compare``: where one lap is faster than another, as a page and as tables."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_torcs.car import KMH
from sb3_torcs.cli.common import DRIVER_HELP, TRUST_HELP, positive, print_json, quiet_output, table
from sb3_torcs.files import writable_file

if TYPE_CHECKING:
    from sb3_torcs.telemetry.comparison import Comparison

__all__ = ["add_parser", "run"]

LAP_HEADERS = ("driver", "lap s", "behind s")
CORNER_HEADERS = ("corner", "m", "brakes m before", "entry km/h", "slowest km/h",
                  "exit km/h", "lost s")  # fmt: skip

DESCRIPTION = """\
Compare the best laps of drivers on one track: agents, robots, ghosts, and files of saved drives
(.parquet, see --telemetry of evaluate and race). All but saved drives drive --laps laps from the
grid, each alone; the best flying lap of each counts. The first driver is what the others are
measured against.

The page is one HTML file that works offline: map, speed, pedals, steering, gear, place across the
road, wheel slip, time gained and lost, corners, sectors and laps.
"""


def add_parser(subparsers: Any) -> None:
    """
    :param subparsers: of the command
    """
    parser = subparsers.add_parser(
        "compare",
        help="compare laps on a page that shows where time is gained and lost",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("drivers", nargs="+", metavar="DRIVER",
        help=f"{DRIVER_HELP}; or a file of drives")  # fmt: skip
    add("--track", metavar="T", help="default: that of a file or of an agent's training")
    add("--laps", type=positive, default=3, metavar="L", help="laps to drive; default: 3")
    add("--html", default="report.html", metavar="FILE.html",
        help="the page; default: report.html")  # fmt: skip
    add("--trust", action="store_true", help=TRUST_HELP)
    add("--json", action="store_true", help="print one JSON object and nothing else")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    :param args: from the command line
    :return: the exit status
    """
    from sb3_torcs.evaluation.comparing import compare

    html = writable_file(args.html, (".html",))
    with quiet_output(args.json):
        report = compare(*args.drivers, track=args.track, laps=args.laps, trust=args.trust)
    if args.json:
        print_json(report.comparison.as_dict(str(html)))
    else:
        _show(report.comparison, html)
    report.save(html)
    if not args.json:
        print(f"page: {html}")
    return 0


def _show(comparison: Comparison, html: Path) -> None:
    """Print laps, corners and what is missing."""
    from sb3_torcs.telemetry.page import missing, summary

    figures = comparison.as_dict(str(html))
    drivers = [driver for driver in figures["drivers"] if driver["lap_time"] is not None]
    print(figures["track"])
    print(table(LAP_HEADERS, [
        (d["driver"], f"{d['lap_time']:.3f}", f"{d['delta_at_end']:.3f}") for d in drivers
    ]))  # fmt: skip
    for driver in drivers if comparison.corners else ():
        print(f"\n{driver['driver']}, by corner")
        rows = [_corner_row(number, corner) for number, corner in enumerate(driver["corners"])]
        print(table(CORNER_HEADERS, rows))
    for sentence in (*summary(comparison), *missing(comparison)):
        print(sentence)


def _corner_row(number: int, corner: dict[str, Any]) -> tuple[str, ...]:
    brakes = corner["braking_point"]
    speeds = (corner["entry_speed"], corner["apex_speed"], corner["exit_speed"])
    return (
        str(number + 1),
        f"{corner['distance']:.0f}",
        "-" if brakes is None else f"{round(corner['distance'] - brakes)}",
        *(f"{KMH * speed:.0f}" for speed in speeds),
        f"{corner['time_lost']:.3f}",
    )
