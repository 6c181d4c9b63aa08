"""``sb3-torcs tracks``: list the tracks, or draw one."""

from __future__ import annotations

import argparse
from typing import Any

from sb3_torcs.cli.common import print_json, table
from sb3_torcs.files import PICTURES, writable_file

__all__ = ["add_parser", "run"]

HEADERS = ("name", "category", "length m", "width m", "tightest radius m", "source")


def add_parser(subparsers: Any) -> None:
    """
    :param subparsers: of the command
    """
    parser = subparsers.add_parser(
        "tracks",
        help="list the tracks, or draw one",
        description="List the bundled tracks and those of an installed TORCS, or draw one.",
    )
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help="a track or the path of its file; default: all"
    )
    parser.add_argument("--json", action="store_true", help="print a JSON list and nothing else")
    parser.add_argument(
        "--plot", metavar="FILE", help="draw the named track into this file (.png, .svg, .pdf)"
    )
    parser.add_argument(
        "--racing-line",
        action="store_true",
        help="draw the racing line, too, coloured by how fast it may be driven on a level road",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    :param args: from the command line
    :return: the exit status
    """
    import numpy as np

    from sb3_torcs.errors import InvalidOption
    from sb3_torcs.tracks.catalogue import available_tracks, load_track

    if args.racing_line and args.plot is None:
        raise InvalidOption("--racing-line is drawn; say where: --plot FILE.png")
    tracks = [load_track(name, np.random.default_rng(0)) for name in args.names]
    if args.plot is not None:
        if len(tracks) != 1:
            raise InvalidOption(
                f"--plot draws one track, but {len(tracks)} are named; "
                "type e.g.: sb3-torcs tracks aalborg --plot aalborg.png"
            )
        plot = writable_file(args.plot, PICTURES)
    summaries = [track.summary() for track in tracks] if tracks else available_tracks()
    if args.json:
        print_json([summary._asdict() for summary in summaries])
    else:
        print(table(HEADERS, [
            (s.name, s.category, f"{s.length_m:.1f}", f"{s.width_m:.1f}",
             f"{s.tightest_radius_m:.1f}", s.source)
            for s in summaries
        ]))  # fmt: skip
    if args.plot is not None:
        from sb3_torcs.tracks.plot import plot_track
        from sb3_torcs.tracks.racing_line import driven

        line, speed = driven(tracks[0]) if args.racing_line else (None, None)
        plot_track(tracks[0], plot, line, speed, label="speed that the road allows [km/h]")
        if not args.json:
            print(f"drawn: {plot}")
    return 0
