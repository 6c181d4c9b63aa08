"""``sb3-torcs install-torcs``: install the game, with or without root."""

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
Install TORCS, if it is not installed yet.

This works on Debian and Ubuntu. Root installs the packages with apt-get. Other users, and root
with --user, download the packages and those of missing libraries, and unpack them into their own
data folder; nothing else changes.

--video also installs Xvfb, which needs root. Videos and pictures of the game need Xvfb where there
is no display.
"""


def add_parser(subparsers: Any) -> None:
    """
    :param subparsers: of the command
    """
    parser = subparsers.add_parser(
        "install-torcs",
        help="install the game, which Torcs-v0 needs",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add(
        "--check",
        action="store_true",
        help="only check; the exit status is 1 if it is not installed",
    )
    add("--user", action="store_true", help="unpack it for this user, even when run as root")
    add(
        "--video",
        action="store_true",
        help="also get Xvfb, for videos where there is no display",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    :param args: from the command line
    :return: the exit status: 1 if the game is not installed at the end
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
    """Find the game; install it if it is missing, unless --check is given."""
    try:
        return find_game()
    except BackendUnavailable as absent:
        if args.check:
            raise
        if sys.platform in ("win32", "darwin"):
            raise InstallFailed(
                "the game is installed on Linux only; on Windows the whole package runs in WSL 2, "
                "and TorcsLite-v0 needs no game"
            ) from None
        return install_game(absent, tell, for_user=args.user or os.geteuid() != 0)
