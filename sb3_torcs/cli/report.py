"""``sb3-torcs report``: the learning curves and tables of a study."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

__all__ = ["add_parser", "run"]


def add_parser(subparsers: Any) -> None:
    """
    :param subparsers: of the command
    """
    parser = subparsers.add_parser(
        "report",
        help="learning curves and tables of a study, every seed shown",
        description="Write report.md and its pictures from the results of a study, also while it "
        "still runs.",
    )
    parser.add_argument("folder", metavar="FOLDER", help="of the study, e.g. logs/studies/smoke")
    parser.add_argument("--output", metavar="DIR", help="for the report; default: FOLDER")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    :param args: from the command line
    :return: the exit status
    """
    from sb3_torcs.studies.report import write_report

    folder = Path(os.path.expanduser(args.folder))
    print(write_report(folder, Path(os.path.expanduser(args.output)) if args.output else folder))
    return 0
