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
        help="write learning curves and tables of a study, with every seed",
        description="Write report.html, a page that works offline, and report.md with pictures. "
        "The study may still run.",
    )
    parser.add_argument(
        "folder", metavar="FOLDER", help="the study's folder, e.g. logs/studies/smoke"
    )
    parser.add_argument("--output", metavar="DIR", help="folder of the report; default: FOLDER")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    :param args: from the command line
    :return: the exit status
    """
    from sb3_torcs.studies.report import write_report

    folder = Path(os.path.expanduser(args.folder))
    output = Path(os.path.expanduser(args.output)) if args.output else folder
    report = write_report(folder, output)
    print(report)
    print(report.with_suffix(".html"))
    return 0
