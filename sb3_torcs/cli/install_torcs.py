"""``sb3-torcs install-torcs``: get the game, with or without root."""

from __future__ import annotations

import argparse
import os
import sys
from functools import partial
from typing import Any

from sb3_torcs.errors import BackendUnavailable, InstallFailed
from sb3_torcs.torcs.installation import Game, find_game
from sb3_torcs.torcs.packages import Tell, install_display, install_game

__all__ = ["add_parser", "run"]

DESCRIPTION = """\
Get TORCS, if it is not here yet.

Debian and Ubuntu: as root by apt-get; otherwise, or with --user, its packages and those of the
libraries that this system lacks are downloaded and unpacked into your own data folder, which
needs no root and changes nothing else.

With --video also Xvfb, as root only: a video or a picture of the game needs it where there is no
display.
"""


def add_parser(subparsers: Any) -> None:
    """
    :param subparsers: of the command
    """
    parser = subparsers.add_parser(
        "install-torcs",
        help="get the game that Torcs-v0 drives",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--check", action="store_true", help="only say whether it is here; 1 if it is not")
    add("--user", action="store_true", help="unpack it for this user, even as root")
    add(
        "--video",
        action="store_true",
        help="also get Xvfb, for videos where there is no display",
    )
    add("--film", dest="video", action="store_true", help=argparse.SUPPRESS)  # its older name
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    :param args: from the command line
    :return: the exit status: 1 when the game is not there at the end
    """
    tell = partial(print, flush=True)
    try:
        game = _found_or_installed(args, tell)
        tell(f"TORCS is installed: data in {game.data}, libraries in {game.libraries}")
        if args.video:
            tell(f"Xvfb is installed: {install_display(tell, only_look=args.check)}")
    except (BackendUnavailable, InstallFailed) as error:
        print(f"sb3-torcs: {error}", file=sys.stderr)
        return 1
    return 0


def _found_or_installed(args: argparse.Namespace, tell: Tell) -> Game:
    """Find the game, and install it if it is not there and may be."""
    try:
        return find_game()
    except BackendUnavailable as absent:
        if args.check:
            raise
        return install_game(absent, tell, for_user=args.user or os.geteuid() != 0)
